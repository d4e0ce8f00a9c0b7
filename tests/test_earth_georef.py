from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from onthefly3r.earth.georef import check_crs, georeference, world_frame
from onthefly3r.earth.positions import usable_positions
from onthefly3r.errors import GeoreferenceError, OptionError
from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.geometry.geodesy import EnuFrame, scale_factor
from onthefly3r.geometry.geoid import egm96_undulation_m
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.intake.folder import read_photographs
from onthefly3r.options import GeoreferenceOptions, IntakeOptions
from onthefly3r.records import Attitude, GeoReference, GpsFix, Shot, VerticalReference

HOME = EnuFrame(47.0, 8.5, 500.0)


@dataclass(frozen=True)
class Survey:
    """Strips of cameras with true poses in ENU, seen in a map of arbitrary scale, turn and shift."""

    enu_from_cam: list[Rigid3]
    attitudes: list[Attitude]
    map_from_enu: Sim3
    rng: np.random.Generator

    @property
    def centres(self) -> np.ndarray:
        return np.array([pose.translation for pose in self.enu_from_cam])

    @property
    def map_from_cam(self) -> dict[int, Rigid3]:
        return {i: self.map_from_enu.apply_to_pose(pose) for i, pose in enumerate(self.enu_from_cam)}

    @property
    def ground_normal(self) -> np.ndarray:
        return np.asarray(self.map_from_enu.rotation[:, 2])

    def noise(self, sigma_m: float) -> np.ndarray:
        return self.rng.normal(0.0, (sigma_m, sigma_m, 1.5 * sigma_m), (len(self.enu_from_cam), 3))

    def shots(
        self,
        error_m: np.ndarray,
        *,
        gimbal: bool = False,
        vertical: VerticalReference = "unknown",
        sigma_m: float | None = None,
        step_s: float = 3.0,
        home: EnuFrame = HOME,
    ) -> dict[int, Shot]:
        positions = home.to_geographic(self.centres + error_m)
        return {
            i: Shot(
                f"{i}.jpg", Path(f"{i}.jpg"), 4000, 3000, "camera", 0.8, 0.05, "option",
                time_s=step_s * i,
                gps=GpsFix(float(lat), float(lon), float(height), vertical, sigma_m, sigma_m),
                attitude=self.attitudes[i] if gimbal else None,
            )
            for i, (lat, lon, height) in enumerate(positions)
        }  # fmt: skip


def survey(seed: int, strips: int = 4, images: int = 12, pitch_deg: float = -90.0, wander_m: float = 2.0) -> Survey:
    """Fly strips 25 m apart, photographs 12 m apart, 80 m above ground; cameras lean 0.7 degrees at random."""
    rng = np.random.default_rng(seed)
    poses, attitudes = [], []
    for strip in range(strips):
        for k in range(images):
            along = 12.0 * (k if strip % 2 == 0 else images - 1 - k)
            yaw = 0.0 if strip % 2 == 0 or pitch_deg > -89.0 else 180.0
            attitude = Attitude(yaw + rng.normal(0, 2), pitch_deg + rng.normal(0, 0.7), rng.normal(0, 0.7))
            position = np.array([25.0 * strip, along, 80.0]) + rng.normal(0, wander_m, 3)
            attitudes.append(attitude)
            poses.append(
                Rigid3(enu_from_cam_rotation(attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg), position)
            )
    map_from_enu = Sim3(0.037, rotation_exp(1.5 * rng.normal(size=3)), 10.0 * rng.normal(size=3))
    return Survey(poses, attitudes, map_from_enu, rng)


def tilt_deg(found: GeoReference, truth: Survey) -> float:
    """Angle between found and true up."""
    turned = found.enu_from_map.rotation @ truth.map_from_enu.rotation
    return float(np.degrees(np.arccos(np.clip(turned[2, 2], -1.0, 1.0))))


def horizontal_error_m(found: GeoReference, truth: Survey) -> float:
    frame = EnuFrame(found.origin_lat_deg, found.origin_lon_deg, found.origin_height_m)
    true = frame.from_geographic(HOME.to_geographic(truth.centres))
    centres = np.array([pose.translation for pose in truth.map_from_cam.values()])
    return float(np.sqrt(((found.enu_from_map.apply(centres) - true)[:, :2] ** 2).sum(axis=1).mean()))


def scale_error(found: GeoReference, truth: Survey) -> float:
    return abs(found.enu_from_map.scale * truth.map_from_enu.scale - 1.0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("pitch_deg", [-90.0, -60.0])
def test_precise_positions_win(seed: int, pitch_deg: float) -> None:
    """0.3 m noise on a 130 m block: level within 1 degree, whatever the habits of drone cameras suggest."""
    s = survey(seed, pitch_deg=pitch_deg)
    found = georeference(s.map_from_cam, s.shots(s.noise(0.3)), GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 1.0
    assert scale_error(found, s) < 0.01
    assert horizontal_error_m(found, s) < 0.3
    assert (found.n_used, found.n_outliers) == (48, 0)
    assert 0.3 < found.rmse_h_m < 0.6
    assert 0.3 < found.rmse_v_m < 0.8
    assert "positions" in found.method.split("up direction from ")[1].split(",")[0]


@pytest.mark.parametrize("seed", range(2))
def test_sloping_ground_does_not_tilt_precise_positions(seed: int) -> None:
    s = survey(seed)
    slope = s.map_from_enu.rotation @ rotation_exp(np.radians([15.0, 0.0, 0.0])) @ np.array([0.0, 0.0, 1.0])
    assert tilt_deg(georeference(s.map_from_cam, s.shots(s.noise(0.3)), GeoreferenceOptions(), slope), s) < 1.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("common", [True, False], ids=["same offset", "scattered"])
def test_a_fifth_of_blunders_of_100_m(seed: int, common: bool) -> None:
    s = survey(seed)
    error, bad = s.noise(0.5), s.rng.choice(48, 10, replace=False)
    error[bad] += (100.0, 0.0, 60.0) if common else 100.0 * s.rng.choice([-1.0, 1.0], (10, 3))
    found = georeference(s.map_from_cam, s.shots(error), GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 1.5
    assert horizontal_error_m(found, s) < 0.5
    assert 10 <= found.n_outliers <= 12
    assert found.n_used <= 38
    assert set(found.residuals_m) == set(range(48))
    assert min(np.linalg.norm(found.residuals_m[i]) for i in bad) > 50.0


@pytest.mark.parametrize(("gimbal", "limit_deg"), [(True, 1.5), (False, 10.0)])
@pytest.mark.parametrize("seed", range(3))
def test_drifting_heights_are_not_followed(seed: int, gimbal: bool, limit_deg: float) -> None:
    """48 m of height drift over the flight tilt a plain fit by 30 degrees; level witnesses are good to 5 degrees."""
    s = survey(seed)
    error = s.noise(1.0)
    error[:, 2] += np.arange(48.0)
    found = georeference(s.map_from_cam, s.shots(error, gimbal=gimbal), GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < limit_deg
    assert horizontal_error_m(found, s) < 1.0
    assert any("heights drift" in warning for warning in found.warnings)
    assert found.rmse_v_m > 10.0  # told as it is, not after the drift is taken out


@pytest.mark.parametrize("seed", range(4))
def test_a_bent_map_does_not_tilt_precise_heights(seed: int) -> None:
    """A map stretched by 0.6 % one way fits better when tilted by 6 degrees; 160 heights to 0.5 m forbid it."""
    s = survey(seed, strips=8, images=20)
    error = s.noise(0.3) + s.centres * (-0.006, 0.0, 0.0)
    slope = s.map_from_enu.rotation @ rotation_exp(np.radians([0.0, 9.0, 0.0])) @ np.array([0.0, 0.0, 1.0])
    assert tilt_deg(georeference(s.map_from_cam, s.shots(error), GeoreferenceOptions(), slope), s) < 1.0


def test_a_constant_height_error_moves_and_does_not_tilt() -> None:
    s = survey(0)
    shots = s.shots(s.noise(0.5) + np.array([0.0, 0.0, 70.0]))
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 1.0
    assert found.origin_height_m == pytest.approx(500.0 + 80.0 + 70.0, abs=3.0)


def test_a_second_flight_with_another_height_bias_does_not_tilt() -> None:
    s = survey(1)
    error = s.noise(0.5)
    error[24:, 2] += 12.0  # the eastern half of the block
    shots = s.shots(error)
    shots = {i: replace(shot, time_s=(shot.time_s or 0.0) + (900.0 if i >= 24 else 0.0)) for i, shot in shots.items()}
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 3.0
    assert any("2 flights" in warning for warning in found.warnings)


def test_line_needs_gimbal_angles() -> None:
    s = survey(2, strips=1, images=20, wander_m=0.5)
    error = s.noise(0.5)
    with pytest.raises(GeoreferenceError, match="along one line"):
        georeference(s.map_from_cam, s.shots(error), GeoreferenceOptions(), s.ground_normal)
    found = georeference(s.map_from_cam, s.shots(error, gimbal=True), GeoreferenceOptions())
    assert tilt_deg(found, s) < 2.0
    assert scale_error(found, s) < 0.02


def test_a_weaving_strip_with_precise_positions_is_no_line() -> None:
    s = survey(2, strips=1, images=20, wander_m=5.0)
    found = georeference(s.map_from_cam, s.shots(s.noise(0.02), sigma_m=0.02), GeoreferenceOptions())
    assert tilt_deg(found, s) < 0.5


def wrong(shots: dict[int, Shot], turn: Callable[[Attitude], Attitude]) -> dict[int, Shot]:
    return {i: replace(s, attitude=turn(s.attitude) if s.attitude else None) for i, s in shots.items()}


@pytest.mark.parametrize("with_ground", [True, False])
@pytest.mark.parametrize("pitch_deg", [-89.0, -75.0])
def test_a_survey_is_never_upside_down(pitch_deg: float, with_ground: bool) -> None:
    """Gimbal pitches with the wrong sign say that the cameras look up: they are left out, and it is told."""
    s = survey(0, pitch_deg=pitch_deg)
    shots = wrong(s.shots(s.noise(0.5), gimbal=True), lambda a: replace(a, pitch_deg=-a.pitch_deg))
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal if with_ground else None)
    assert tilt_deg(found, s) < 6.0
    assert "gimbal angles" in found.warnings[0] and "left out" in found.warnings[0]


def test_angles_that_contradict_ground_and_positions_are_left_out() -> None:
    """Angles that are 90 degrees off in pitch make a fit impossible that works without them."""
    s = survey(1, pitch_deg=-88.0)
    shots = wrong(s.shots(s.noise(0.5), gimbal=True), lambda a: replace(a, yaw_deg=30.0, pitch_deg=-1.0))
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 6.0
    assert "contradict" in found.warnings[0]


def test_a_wall_that_is_photographed_from_the_side_keeps_its_angles() -> None:
    """Cameras that look at a wall: its plane is not the ground, and the gimbal angles are right."""
    s = survey(0, pitch_deg=-2.0)
    wall = s.map_from_enu.rotation @ np.array([0.0, -1.0, 0.0])
    found = georeference(s.map_from_cam, s.shots(s.noise(0.5), gimbal=True), GeoreferenceOptions(), wall)
    assert tilt_deg(found, s) < 3.0
    assert not any("gimbal" in warning for warning in found.warnings)


def test_a_line_with_mistaken_angles_says_so() -> None:
    s = survey(2, strips=1, images=20, wander_m=0.5)
    shots = wrong(s.shots(s.noise(0.5), gimbal=True), lambda a: replace(a, pitch_deg=-a.pitch_deg))
    with pytest.raises(GeoreferenceError, match=r"along one line.*look up"):
        georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)


def test_places_are_counted_without_their_heights() -> None:
    """All photographs at one place whose heights differ are one position, not many."""
    s = survey(0)
    error = -s.centres * (1.0, 1.0, 0.0)
    with pytest.raises(GeoreferenceError, match="1 of them different"):
        georeference(s.map_from_cam, s.shots(error), GeoreferenceOptions(), s.ground_normal)


def test_a_minority_of_tags_does_not_decide_what_heights_refer_to() -> None:
    s = survey(0)
    shots = s.shots(s.noise(0.3))
    for i in range(5):
        fix = shots[i].gps
        assert fix is not None
        shots[i] = replace(shots[i], gps=replace(fix, vertical="egm96"))
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)
    assert found.vertical == "unknown"
    assert any("43 unknown, 5 egm96" in warning and "--vertical" in warning for warning in found.warnings)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_positions(count: int) -> None:
    s = survey(0)
    shots = {i: shot if i < count else replace(shot, gps=None) for i, shot in s.shots(s.noise(0.5)).items()}
    with pytest.raises(GeoreferenceError, match=f"{count} of 48 placed photographs have a position"):
        georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)


def test_identical_positions() -> None:
    s = survey(0)
    with pytest.raises(GeoreferenceError, match="1 of them different"):
        georeference(s.map_from_cam, s.shots(-s.centres), GeoreferenceOptions(), s.ground_normal)


def test_three_positions_are_enough_with_gimbal_angles() -> None:
    s = survey(0, strips=1, images=3, wander_m=10.0)
    found = georeference(s.map_from_cam, s.shots(s.noise(0.3), gimbal=True), GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 3.0
    assert scale_error(found, s) < 0.1


def test_repeated_positions_weigh_like_one() -> None:
    """Twenty photographs carry the first one's position."""
    s = survey(4)
    error = s.noise(0.3)
    error[:20] = s.centres[0] - s.centres[:20]
    shots = s.shots(error)
    sigma_h_m = usable_positions(range(48), shots, GeoreferenceOptions()).sigma_h_m
    assert (sigma_h_m[:20] ** -2.0).sum() == pytest.approx(sigma_h_m[20] ** -2.0)
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)
    assert scale_error(found, s) < 0.02
    assert horizontal_error_m(found, s) < 1.0
    assert any("share 29 positions" in warning for warning in found.warnings)


@pytest.mark.parametrize("kind", ["unrelated", "mirrored"])
def test_positions_that_do_not_fit(kind: str) -> None:
    s = survey(0)
    mirrored = s.centres * (-2.0, 0.0, 0.0) + s.noise(0.3)
    error = mirrored if kind == "mirrored" else s.rng.normal(0.0, 100.0, (48, 3))
    with pytest.raises(GeoreferenceError, match="do not fit the map"):
        georeference(s.map_from_cam, s.shots(error), GeoreferenceOptions(), s.ground_normal)


def test_photographs_without_height_or_position() -> None:
    s = survey(0)
    shots = s.shots(s.noise(0.3))
    for i in range(0, 48, 4):
        shots[i] = replace(shots[i], gps=None)
        shots[i + 1] = replace(shots[i + 1], gps=replace(shots[i + 1].gps, height_m=None))
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(found, s) < 1.0
    assert found.n_used == 36
    no_heights = {
        i: replace(shot, gps=None if shot.gps is None else replace(shot.gps, height_m=None))
        for i, shot in shots.items()
    }
    flat = georeference(s.map_from_cam, no_heights, GeoreferenceOptions(), s.ground_normal)
    assert tilt_deg(flat, s) < 3.0
    assert flat.vertical == "unknown"
    assert any("no photograph states a height" in warning for warning in flat.warnings)


def test_seeds_repeat_and_feed_order_does_not_matter() -> None:
    s = survey(5)
    shots = s.shots(s.noise(1.0))
    first, again = (georeference(s.map_from_cam, shots, GeoreferenceOptions(), s.ground_normal, 7) for _ in range(2))
    assert np.array_equal(first.enu_from_map.matrix(), again.enu_from_map.matrix())
    order = np.random.default_rng(0).permutation(48)
    poses = {int(k): s.map_from_cam[int(i)] for k, i in enumerate(order)}
    shuffled = georeference(
        poses, {k: shots[int(i)] for k, i in enumerate(order)}, GeoreferenceOptions(), s.ground_normal, 7
    )
    assert shuffled.enu_from_map.matrix() == pytest.approx(first.enu_from_map.matrix(), abs=1e-3)


@pytest.mark.parametrize(
    ("tags", "option", "expected"),
    [
        ("egm96", "auto", "egm96"),
        ("ellipsoidal", "auto", "ellipsoidal"),
        ("unknown", "auto", "unknown"),
        ("unknown", "egm2008", "egm2008"),
        ("egm96", "ellipsoidal", "ellipsoidal"),
    ],
)
def test_heights_leave_in_the_reference_they_came_in(
    tags: VerticalReference, option: VerticalReference, expected: str
) -> None:
    s = survey(0)
    found = georeference(
        s.map_from_cam,
        s.shots(s.noise(0.02), vertical=tags, sigma_m=0.02),
        GeoreferenceOptions(vertical=option),  # type: ignore[arg-type]
    )
    assert found.vertical == expected
    centres = np.array([pose.translation for pose in s.map_from_cam.values()])
    heights = world_frame(found).from_enu(found.enu_from_map.apply(centres))[:, 2]
    tag_heights = HOME.to_geographic(s.centres)[:, 2]
    assert np.abs(heights - tag_heights).max() < 0.1
    undulation = float(egm96_undulation_m(HOME.lat_deg, HOME.lon_deg))
    expected_origin = np.median(tag_heights) + (undulation if expected in ("egm96", "egm2008") else 0.0)
    assert found.origin_height_m == pytest.approx(expected_origin, abs=0.5)


def test_mixed_height_references_are_brought_together_and_said() -> None:
    s = survey(0)
    shots = s.shots(s.noise(0.02), vertical="ellipsoidal", sigma_m=0.02)
    undulation = float(egm96_undulation_m(HOME.lat_deg, HOME.lon_deg))
    for i in range(0, 48, 5):
        fix = shots[i].gps
        assert fix is not None
        assert fix.height_m is not None
        shots[i] = replace(shots[i], gps=replace(fix, height_m=fix.height_m - undulation, vertical="egm96"))
    found = georeference(s.map_from_cam, shots, GeoreferenceOptions())
    assert found.vertical == "ellipsoidal"
    assert found.rmse_v_m < 0.1
    assert any("different references" in warning for warning in found.warnings)


def test_a_survey_across_the_date_line() -> None:
    """Two strips on each side of 180 degrees: their median is not in Africa."""
    s = survey(0)
    home = EnuFrame(-16.5, 180.0 - 37.5 / 106_700.0, 20.0)
    found = georeference(s.map_from_cam, s.shots(s.noise(0.3), home=home), GeoreferenceOptions(), s.ground_normal)
    assert abs(found.origin_lon_deg) > 179.999
    assert found.crs in ("EPSG:32760", "EPSG:32701")
    assert found.rmse_h_m < 1.0
    assert np.isfinite(world_frame(found).from_enu(np.zeros((1, 3)))).all()


def test_beyond_utm() -> None:
    s = survey(0)
    home = EnuFrame(85.0, 20.0, 20.0)
    found = georeference(s.map_from_cam, s.shots(s.noise(0.3), home=home), GeoreferenceOptions(), s.ground_normal)
    assert found.crs == "EPSG:5041"
    assert found.rmse_h_m < 1.0


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:3395", "EPSG:6933"])
def test_a_projection_that_stretches_lengths_is_refused_unless_forced(crs: str) -> None:
    s = survey(0)
    shots = s.shots(s.noise(0.02))
    with pytest.raises(OptionError, match="times the true ones"):
        check_crs(shots, GeoreferenceOptions(crs=crs))
    check_crs(shots, GeoreferenceOptions(crs=crs, force_crs=True))


def test_scale_factor_of_web_mercator_is_the_secant_of_the_latitude() -> None:
    assert scale_factor("EPSG:3857", 46.84, -92.0) == pytest.approx(1.0 / np.cos(np.radians(46.84)), rel=0.004)
    assert scale_factor("EPSG:32633", 48.0, 15.0) == pytest.approx(0.9996, abs=1e-6)
    assert scale_factor("EPSG:5041", 89.9, 0.0) == pytest.approx(0.994, abs=1e-4)


def test_target_crs() -> None:
    s = survey(0)
    shots = s.shots(s.noise(0.3))

    def target(crs: str | None) -> GeoReference:
        return georeference(s.map_from_cam, shots, GeoreferenceOptions(crs=crs), s.ground_normal)

    assert target(None).crs == "EPSG:32632"
    swiss = target("EPSG:2056")
    east, north, _ = world_frame(swiss).from_enu(np.zeros((1, 3)))[0]
    assert 2_480_000 < east < 2_850_000
    assert 1_070_000 < north < 1_300_000
    for bad in ("EPSG:4326", "nonsense", "EPSG:2225"):
        with pytest.raises(OptionError, match="crs"):
            target(bad)


def reference_model(folder: Path, shots: list[Shot]) -> dict[int, Rigid3]:
    """Read the poses of a COLMAP text model without the project's own reader."""
    index = {shot.name: i for i, shot in enumerate(shots)}
    poses = {}
    for line in (folder / "images.txt").read_text().splitlines():
        fields = line.split()
        if len(fields) == 10 and not line.startswith("#"):
            w, x, y, z, *shift = map(float, fields[1:8])
            cam_from_map = Rigid3(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(shift))
            poses[index[fields[9]]] = cam_from_map.inverse()
    return poses


@pytest.mark.photographs
@pytest.mark.parametrize(
    ("name", "crs", "rmse_h_m", "rmse_v_m", "tilt_limit_deg"),
    [
        ("brighton_beach", "EPSG:32615", 0.8, 0.6, 3.0),
        ("sheffield_cross", "EPSG:32617", 0.6, 0.6, 17.5),  # flown 15 degrees off nadir
        ("caliterra", "EPSG:32614", 20.0, 50.0, 10.0),  # heights climb 114 m although the drone flew level
    ],
)
def test_real_surveys_come_out_level(
    photograph_sets: Path, name: str, crs: str, rmse_h_m: float, rmse_v_m: float, tilt_limit_deg: float
) -> None:
    shots, _ = read_photographs(photograph_sets / name / "photos", IntakeOptions())
    poses = reference_model(photograph_sets / name / "reference", shots)
    found = georeference(poses, dict(enumerate(shots)), GeoreferenceOptions())
    views = np.array([found.enu_from_map.rotation @ pose.rotation[:, 2] for pose in poses.values()])
    assert float(np.degrees(np.arccos(-views[:, 2])).mean()) < tilt_limit_deg
    assert found.crs == crs
    assert found.rmse_h_m < rmse_h_m
    assert found.rmse_v_m < rmse_v_m
    assert found.n_used >= 0.9 * len(poses)


@pytest.mark.photographs
def test_gimbal_convention_on_real_photographs(photograph_sets: Path) -> None:
    """Gimbal angles agree with the adjusted cameras: view within 4 degrees; yaw within 6 on northbound strips.

    The photographs of the middle strip are stored turned by 180 degrees against their gimbal yaw.
    """
    folder = photograph_sets / "brighton_beach"
    shots, _ = read_photographs(folder / "photos", IntakeOptions())
    poses = reference_model(folder / "reference", shots)
    found = georeference(poses, dict(enumerate(shots)), GeoreferenceOptions())
    for i, pose in poses.items():
        attitude = shots[i].attitude
        assert attitude is not None
        gimbal = enu_from_cam_rotation(attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg)
        camera = found.enu_from_map.rotation @ pose.rotation
        assert np.degrees(np.arccos(gimbal[:, 2] @ camera[:, 2])) < 4.0
        if attitude.yaw_deg > 0.0:
            assert np.degrees(np.arccos(gimbal[:, 1] @ camera[:, 1])) < 6.0
