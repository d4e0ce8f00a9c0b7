"""The demonstration's figures, against a reconstruction whose errors are known because they are made here."""

from __future__ import annotations

import json
import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r.commands.demo import compare_with_truth, run_demo
from onthefly3r.errors import Cancelled, InputError
from onthefly3r.geometry.frames import omega_phi_kappa_deg
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.transforms import rotation_exp
from onthefly3r.options import Options
from onthefly3r.protocol import Progress
from onthefly3r.simulate.flight import Survey, SurveyOptions, plan_survey

SMALL = SurveyOptions(images=6, strips=2, image_width_px=400, image_height_px=300)
SHIFT_M = np.array([0.3, 0.0, 0.4])  # east, north, up
ROLL_RAD = np.radians([0.0, 0.0, 0.2])  # of every camera about its viewing axis


@dataclass(frozen=True)
class FakeResult:
    report: dict[str, Any]


def write_shifted_truth(survey: Survey, folder: Path, noise_m: float) -> FakeResult:
    """Write the true cameras and surface, both shifted by SHIFT_M, heights above EGM96; one camera is unplaced."""
    import laspy

    folder.mkdir(parents=True)
    origin = survey.origin
    world = WorldFrame("EPSG:32633", "egm96", EnuFrame(origin.lat_deg, origin.lon_deg, origin.height_m))
    centres = np.array([view.enu_from_cam.translation for view in survey.views])
    noise = noise_m * np.random.default_rng(0).standard_normal(centres.shape)
    lines = ["image,x,y,z,omega,phi,kappa,status"]
    for view, (x, y, z) in zip(survey.views[:-1], world.from_enu(centres + SHIFT_M + noise), strict=False):
        rotation = world.rotation_world_from_enu() @ view.enu_from_cam.rotation @ rotation_exp(ROLL_RAD)
        omega, phi, kappa = omega_phi_kappa_deg(rotation)
        lines.append(f"{view.name},{x:.6f},{y:.6f},{z:.6f},{omega:.6f},{phi:.6f},{kappa:.6f},placed")
    lines.append(f"{survey.views[-1].name},,,,,,,rejected")
    (folder / "trajectory.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    points = survey.scene.sample_surface(20_000, seed=0).points
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, 0.001), np.array([500_000.0, 5_300_000.0, 0.0])
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = world.from_enu(points + SHIFT_M).T
    cloud.write(folder / "cloud.laz")
    georeference = {"crs": "EPSG:32633", "vertical": "egm96"}
    return FakeResult({"georeference": georeference, "cloud": {"path": "cloud.laz", "points": len(points)}})


def test_figures_tell_shift_from_shape(tmp_path: Path) -> None:
    survey = plan_survey(SMALL)
    result = write_shifted_truth(survey, tmp_path / "result", noise_m=0.0)
    figures = compare_with_truth(result.report, tmp_path / "result", survey, Options())
    assert figures.cameras == 5
    assert figures.ate_m < 1e-4
    assert figures.are_deg == pytest.approx(0.2, abs=1e-3)
    assert figures.camera_absolute_h_m == pytest.approx(0.3, abs=1e-4)
    assert figures.camera_absolute_v_m == pytest.approx(0.4, abs=1e-4)
    assert figures.cloud_points == result.report["cloud"]["points"]
    # The file keeps millimetres; the shift is 0.5 m along a slant, less where the surface runs along it.
    assert figures.cloud_fitted_m < 0.002
    assert 0.2 < figures.cloud_absolute_m <= 0.5
    camera = survey.views[0].camera
    assert figures.gsd_m == pytest.approx(SMALL.altitude_m / camera.fx)
    assert figures.cloud_fitted_gsd == pytest.approx(figures.cloud_fitted_m / figures.gsd_m)


def test_noise_of_cameras_is_the_trajectory_error(tmp_path: Path) -> None:
    survey = plan_survey(SurveyOptions(images=40, strips=4))
    result = write_shifted_truth(survey, tmp_path / "result", noise_m=0.1)
    figures = compare_with_truth(result.report, tmp_path / "result", survey, Options())
    # 39 cameras with 0.1 m in each of 3 coordinates, less the 7 parameters of the fit; 4 sigma of the estimate.
    expected = 0.1 * np.sqrt(3.0 * (1 - 7 / 117))
    assert figures.ate_m == pytest.approx(expected, rel=4 / np.sqrt(2 * 110))
    assert figures.ate_percent == pytest.approx(100 * figures.ate_m / 80.0)


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> None:
    def reconstruct(photos: Path, out: Path, options: Options, progress: Any, cancel: Any) -> FakeResult:
        assert len(list(photos.glob("*.JPG"))) == SMALL.images
        return write_shifted_truth(plan_survey(SMALL), out, noise_m=0.0)

    module = types.ModuleType("onthefly3r.run.session")
    module.reconstruct = reconstruct  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "onthefly3r.run.session", module)


def test_demo_renders_reconstructs_and_measures(engine: None, tmp_path: Path) -> None:
    out = tmp_path / "a demo with späce"
    demo = run_demo(out, survey_options=SMALL)
    assert json.loads((out / "accuracy.json").read_text(encoding="utf-8"))["cameras"] == demo.accuracy.cameras == 5
    assert (out / "truth" / "origin.json").exists()


def test_demo_leaves_other_folders_alone(engine: None, tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(InputError, match="name another folder"):
        run_demo(tmp_path, survey_options=SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


def test_demo_can_be_stopped_while_it_renders(engine: None, tmp_path: Path) -> None:
    def stop(report: Progress) -> None:
        raise Cancelled("stopped on request")

    with pytest.raises(Cancelled):
        run_demo(tmp_path / "out", stop, survey_options=SMALL)
    assert not (tmp_path / "out" / "result").exists()
