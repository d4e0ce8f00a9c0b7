"""Local coordinates stand level and have the true scale, by the same evidence as georeferenced ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.earth.local_level import local_frame, scale_warning, turning_up
from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.geometry.geodesy import EnuFrame
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.options import GeoreferenceOptions
from onthefly3r.records import Attitude, GpsFix, Shot

HOME = EnuFrame(48.2, 15.6, 300.0)
MAP_FROM_ENU = Sim3(0.037, rotation_exp(np.array([0.4, -1.1, 0.6])), np.array([3.0, 1.0, -2.0]))
LOCAL = GeoreferenceOptions(local=True)


def flight(
    slope: float = 0.0, strips: int = 4, positions: bool = True, gimbal: bool = True, sigma_m: float = 0.02
) -> tuple[dict[int, Rigid3], dict[int, Shot], np.ndarray]:
    """Cameras 80 m above ground that rises by `slope` to the north, looking down; poses in the map frame."""
    rng = np.random.default_rng(0)
    poses, shots, up_normal = {}, {}, np.array([0.0, -slope, 1.0]) / np.hypot(1.0, slope)
    for index in range(strips * 12):
        east, north = 25.0 * (index // 12), 12.0 * (index % 12)
        centre = np.array([east, north, 80.0 + slope * north]) + rng.normal(0.0, 1.0, 3)
        attitude = Attitude(rng.normal(0.0, 2.0), -90.0 + rng.normal(0.0, 0.7), rng.normal(0.0, 0.7))
        rotation = enu_from_cam_rotation(attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg)
        poses[index] = MAP_FROM_ENU.apply_to_pose(Rigid3(rotation, centre))
        lat, lon, height = HOME.to_geographic(centre + rng.normal(0.0, sigma_m, 3))
        fix = GpsFix(float(lat), float(lon), float(height), "ellipsoidal", sigma_m, sigma_m) if positions else None
        shots[index] = Shot(
            f"{index}.jpg", Path(f"{index}.jpg"), 4000, 3000, "c", 0.8, 0.05, "guess", time_s=2.0 * index, gps=fix,
            attitude=attitude if gimbal else None,
        )  # fmt: skip
    return poses, shots, MAP_FROM_ENU.rotation @ up_normal


def tilt_deg(found: Sim3) -> float:
    turned = found.rotation @ MAP_FROM_ENU.rotation
    return float(np.degrees(np.arccos(np.clip(turned[2, 2], -1.0, 1.0))))


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_a_survey_on_a_slope_is_level_and_has_its_true_size(slope: float) -> None:
    poses, shots, normal = flight(slope)
    found = local_frame(None, poses, shots, LOCAL, normal)
    assert found.metric and found.warnings == ()
    assert found.level_from_map.scale * 0.037 == pytest.approx(1.0, rel=1e-3)
    assert tilt_deg(found.level_from_map) < 0.1


def test_a_wall_of_photographs_has_its_true_size() -> None:
    """Cameras above each other before a facade: distances on the ground say nothing of the scale."""
    poses, shots, normal = flight(slope=20.0, gimbal=True)
    found = local_frame(None, poses, shots, LOCAL, None)
    assert found.level_from_map.scale * 0.037 == pytest.approx(1.0, rel=5e-3)
    assert normal.shape == (3,)


def test_without_positions_gimbal_angles_level_and_a_metric_model_scales() -> None:
    poses, shots, normal = flight(slope=0.5, positions=False)
    found = local_frame(None, poses, shots, LOCAL, normal, 1.0 / 0.037)
    assert found.metric and found.reference is None
    assert found.level_from_map.scale * 0.037 == pytest.approx(1.0)
    assert tilt_deg(found.level_from_map) < 1.0  # the ground alone would say 27 degrees


def test_without_any_evidence_units_are_not_called_metres() -> None:
    poses, shots, normal = flight(positions=False, gimbal=False)
    found = local_frame(None, poses, shots, LOCAL, normal)
    assert not found.metric and "not metres" in found.warnings[0]
    assert tilt_deg(found.level_from_map) < 1.0


def test_a_metric_model_is_checked_against_positions() -> None:
    poses, shots, normal = flight()
    reference = local_frame(None, poses, shots, LOCAL, normal).reference
    assert reference is not None
    assert scale_warning(reference, 1.0 / 0.037) == ""
    assert "1.50 times" in scale_warning(reference, 1.0 / 0.037 / 1.5)
    assert scale_warning(reference, None) == ""


def test_up_becomes_the_third_axis() -> None:
    for up in np.random.default_rng(0).normal(size=(20, 3)):
        turned = turning_up(up)
        np.testing.assert_allclose(turned @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1.0)
