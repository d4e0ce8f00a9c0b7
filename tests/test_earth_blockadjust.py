"""Everything in one adjustment: control, positions and tracks of a made-up block, its truth known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.earth.blockadjust import Adjusted, adjust_block
from onthefly3r.earth.control_reference import earth_reference
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.options import Options
from onthefly3r.records import GpsFix, Shot
from test_adjust_refine import drifted_map

FRAME = EnuFrame(48.2, 14.0, 300.0)
WORLD = WorldFrame("EPSG:32633", "ellipsoidal", FRAME)
GSD_M = synthetic.HEIGHT / synthetic.CAMERA.fx
TARGETS = np.array(
    [(2.0, 2.0), (58.0, 3.0), (3.0, 38.0), (57.0, 37.0), (30.0, 20.0), (15.0, 12.0), (45.0, 28.0), (30.0, 5.0)]
)
LABELS = ("A", "B", "C", "D", "E", "CHK-1", "CHK-2", "CHK-3")


@pytest.fixture(scope="module")
def truth() -> synthetic.Block:
    return synthetic.block(noise_px=0.3, n_points=1500)


def targets() -> np.ndarray:
    x, y = TARGETS.T
    return np.stack([x, y, 4.0 * np.sin(x / 15.0) * np.cos(y / 11.0)], axis=1)


def seen_from(
    pose: Rigid3, points: np.ndarray, flown_m: float = 0.0, off_px: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Pixels (N, 2) of a camera that flies towards the top of its image while rows are read, its lens off centre."""
    pixel = synthetic.CAMERA.project(pose.inverse().apply(points))
    for _ in range(4):
        at = pose.translation - flown_m * (pixel[:, 1:] / 750.0 - 0.5) * pose.rotation[:, 1]
        pixel = synthetic.CAMERA.project((points - at) @ pose.rotation)
    return pixel + np.array(off_px)


def control_file(
    folder: Path,
    truth: synthetic.Block,
    wrong: Mapping[str, np.ndarray] | None = None,
    flown_m: float = 0.0,
    off_px: tuple[float, float] = (0.0, 0.0),
) -> Path:
    """Targets surveyed to 2 cm, marked to half a pixel; `wrong` are metres added to coordinates."""
    rng = np.random.default_rng(5)
    lines = ["EPSG:32633"]
    for label, place in zip(LABELS, targets(), strict=True):
        surveyed = place + rng.normal(0.0, 0.02, 3) + (wrong or {}).get(label, np.zeros(3))
        east, north, height = WORLD.from_enu(surveyed[None])[0]
        for index, pose in truth.poses.items():
            pixel = seen_from(pose, place[None], flown_m, off_px)[0]
            if (pixel > 5.0).all() and (pixel < (995.0, 745.0)).all():
                u, v = pixel + rng.normal(0.0, 0.5, 2)
                lines.append(f"{east:.4f} {north:.4f} {height:.4f} {u:.3f} {v:.3f} {index}.jpg {label}")
    path = folder / "gcp_list.txt"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def with_positions(truth: synthetic.Block, sigma_h_m: float, sigma_v_m: float, seed: int = 0) -> dict[int, Shot]:
    rng = np.random.default_rng(seed)
    shots = synthetic.shots(truth)
    for index, pose in truth.poses.items():
        noisy = pose.translation + rng.normal(0.0, 1.0, 3) * (sigma_h_m, sigma_h_m, sigma_v_m)
        lat, lon, height = FRAME.to_geographic(noisy)
        shots[index] = replace(shots[index], gps=GpsFix(lat, lon, height, "ellipsoidal"), time_s=float(2 * index))
    return shots


def adjusted(
    folder: Path, truth: synthetic.Block, shots: dict[int, Shot], **options: object
) -> tuple[MapState, Store, Adjusted]:
    state, store = drifted_map(folder / "work", truth)
    found = adjust_block(state, store.stream_observations(), shots, Options.from_flat(options))
    assert found is not None
    state.move_refined(found.refinement.map_from_submap, found.refinement.calibrations)
    if found.tie is not None:
        state.set_tie(found.tie)
    return state, store, found


def rmse(found: Adjusted, role: str) -> tuple[float, float, int]:
    assert found.tie is not None
    own = [p for p in found.tie.control if p.role == role]
    horizontal = np.sqrt(np.mean([p.east_m**2 + p.north_m**2 for p in own]))
    return float(horizontal), float(np.sqrt(np.mean([p.up_m**2 for p in own]))), len(own)


@pytest.mark.parametrize("positions", [False, True])
def test_five_control_points_carry_the_checkpoints(tmp_path: Path, truth: synthetic.Block, positions: bool) -> None:
    """With and without positions: H within a GSD, V within one and a half; the export keeps to the control."""
    shots = with_positions(truth, 1.5, 3.0) if positions else synthetic.shots(truth)
    path = control_file(tmp_path, truth)
    state, _, found = adjusted(tmp_path, truth, shots, control=str(path), vertical="ellipsoidal")
    horizontal, vertical, count = rmse(found, "checkpoint")
    assert count == 3 and horizontal <= GSD_M and vertical <= 1.5 * GSD_M
    assert not [text for text in found.warnings if "left out" in text]
    poses = {i: state.map_from_cam(i) for i in state.frames}
    reference = earth_reference(state.tie, poses, shots, Options().georeference)
    assert reference.crs == "EPSG:32633" and reference.n_used == 5
    enu = EnuFrame(reference.origin_lat_deg, reference.origin_lon_deg, reference.origin_height_m)
    for index in list(truth.poses)[:6]:
        centre = enu.to_geographic(reference.enu_from_map.apply(poses[index].translation))
        off = FRAME.from_geographic(centre) - truth.poses[index].translation
        known = reference.deviations[index]
        assert np.hypot(off[0], off[1]) < 4.0 * known.h_m + 0.01 and abs(off[2]) < 4.0 * known.v_m + 0.01
        assert known.h_m < 0.3
    again = MapState.load(Store(tmp_path / "work"))
    assert again.tie is not None and found.tie is not None
    assert again.tie.control == found.tie.control and again.tie.deviations == found.tie.deviations


@pytest.mark.parametrize(("flown_m", "bound_h"), [(0.0, 1.0), (0.36, 1.25)])
def test_a_lens_off_centre_and_a_rolling_shutter_do_little_harm(
    tmp_path: Path, truth: synthetic.Block, flown_m: float, bound_h: float
) -> None:
    """20 px off: H within a GSD, V within one and a half. 12 m/s and 30 ms from the first row to the last as well: the
    shutter is not modelled, and H comes out between 0.8 and 1.05 GSD from one draw to the next."""
    off_px = (20.0, -12.0)
    rng = np.random.default_rng(3)
    features = {}
    for index, own in truth.features.items():
        exact = seen_from(truth.poses[index], truth.points[truth.seen[index]], flown_m, off_px)
        features[index] = replace(own, pixels=(exact + rng.normal(0.0, 0.3, exact.shape)).astype(np.float32))
    rolled = replace(truth, features=features)
    path = control_file(tmp_path, truth, flown_m=flown_m, off_px=off_px)
    shots = with_positions(truth, 1.5, 3.0)
    _, _, found = adjusted(tmp_path, rolled, shots, control=str(path), vertical="ellipsoidal")
    horizontal, vertical, count = rmse(found, "checkpoint")
    assert count == 3 and horizontal <= bound_h * GSD_M and vertical <= 1.5 * GSD_M
    assert found.refinement.notes["principal_point"][synthetic.KEY].startswith("free")


def test_a_wrong_point_is_named_and_left_out(tmp_path: Path, truth: synthetic.Block) -> None:
    path = control_file(tmp_path, truth, wrong={"C": np.array([1.0, 0.0, 0.0])})
    _, _, found = adjusted(tmp_path, truth, synthetic.shots(truth), control=str(path), vertical="ellipsoidal")
    assert any("C is" in text and "left out" in text for text in found.warnings)
    horizontal, vertical, _ = rmse(found, "checkpoint")
    assert horizontal <= 1.5 * GSD_M and vertical <= 2.5 * GSD_M
    assert found.tie is not None and next(p.role for p in found.tie.control if p.label == "C") == "left out"


def test_a_mark_on_another_target_is_named_and_left_out(tmp_path: Path, truth: synthetic.Block) -> None:
    path = control_file(tmp_path, truth)
    lines = path.read_text().splitlines()
    row = next(k for k, line in enumerate(lines) if line.endswith(" E"))
    words = lines[row].split()
    words[3] = str(float(words[3]) - 80.0 if float(words[3]) > 500.0 else float(words[3]) + 80.0)
    lines[row] = " ".join(words)
    path.write_text("\n".join(lines))
    _, _, found = adjusted(tmp_path, truth, synthetic.shots(truth), control=str(path), vertical="ellipsoidal")
    assert any("a mark of E" in text for text in found.warnings)
    assert rmse(found, "checkpoint")[0] <= GSD_M


def test_marks_in_scaled_copies_are_recognised(tmp_path: Path, truth: synthetic.Block) -> None:
    path = control_file(tmp_path, truth)
    lines = [line.split() for line in path.read_text().splitlines()]
    scaled = [" ".join([*w[:3], *(f"{2.4 * float(v):.3f}" for v in w[3:5]), *w[5:]]) for w in lines[1:]]
    path.write_text("\n".join(["EPSG:32633", *scaled]))
    _, _, found = adjusted(tmp_path, truth, synthetic.shots(truth), control=str(path), vertical="ellipsoidal")
    assert any("copies of 2400 px" in text for text in found.warnings)
    assert rmse(found, "checkpoint")[0] <= GSD_M


def test_control_far_from_the_positions_is_refused_in_plain_words(tmp_path: Path, truth: synthetic.Block) -> None:
    """The photographs keep their positions, and the message says what is wrong with the file."""
    path = control_file(tmp_path, truth)
    path.write_text(path.read_text().replace("EPSG:32633", "EPSG:32632"))
    _, _, found = adjusted(tmp_path, truth, with_positions(truth, 1.5, 3.0), control=str(path))
    assert any("km from the photographs" in text and "another CRS" in text for text in found.warnings)
    assert found.tie is not None and not found.tie.by_control


def test_exchanged_axes_are_told(tmp_path: Path, truth: synthetic.Block) -> None:
    """A local grid whose columns are exchanged stays a place on Earth: it shows as a mirror image."""
    path = control_file(tmp_path, truth)
    lines = [line.split() for line in path.read_text().splitlines()]
    swapped = [" ".join([str(float(w[1]) - 4800000.0), str(float(w[0]) + 4800000.0), *w[2:]]) for w in lines[1:]]
    path.write_text("\n".join(["EPSG:32633", *swapped]))
    _, _, found = adjusted(tmp_path, truth, synthetic.shots(truth), control=str(path))
    assert found.tie is None and any("exchanged" in text for text in found.warnings)


def test_positions_alone_tie_the_block_and_say_how_well(tmp_path: Path, truth: synthetic.Block) -> None:
    """Twelve positions of 1.5 and 3 m: cameras are known to about a metre, and the errors are of that size."""
    state, _, found = adjusted(tmp_path, truth, with_positions(truth, 1.5, 3.0, seed=2))
    assert found.tie is not None and not found.tie.by_control
    sigma = np.median([d.h_m for d in found.tie.deviations.values()])
    assert 0.2 < sigma < 1.5
    off = [
        found.tie.enu_from_map.apply(state.map_from_cam(i).translation) - truth.poses[i].translation
        for i in found.tie.deviations
    ]
    origin = EnuFrame(found.tie.origin_lat_deg, found.tie.origin_lon_deg, found.tie.origin_height_m)
    shift = FRAME.from_geographic(origin.to_geographic(np.zeros((1, 3))))[0]
    assert np.sqrt(np.mean(np.square(np.array(off) + shift)[:, :2])) < 3.0 * sigma


def test_gps_fit_leaves_positions_out_of_the_adjustment(tmp_path: Path, truth: synthetic.Block) -> None:
    _, _, found = adjusted(tmp_path, truth, with_positions(truth, 1.5, 3.0), gps="fit")
    assert found.tie is None
