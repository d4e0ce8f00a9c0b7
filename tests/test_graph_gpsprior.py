"""Positions in the map: they straighten it as far as they are accurate, and doubt images that land elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.geodesy import EnuFrame
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_angle_deg, rotation_exp
from onthefly3r.graph.gpsprior import GpsTie, gps_disagreement, pose_priors, tie_to_positions
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.options import GeoreferenceOptions
from onthefly3r.records import Frame, GpsFix, Shot, Submap

OPTIONS = GeoreferenceOptions()
ORIGIN = EnuFrame(48.2, 15.6, 300.0)
CAMERA = Camera(56, 42, 48.0, 48.0, 28.0, 21.0)
NADIR = np.diag([1.0, -1.0, -1.0])
MAP_FROM_ENU = Sim3(0.01, rotation_exp(np.array([0.4, -1.1, 2.0])), np.array([3.0, -2.0, 0.5]))
RTK_M, CONSUMER_M = 0.02, 3.0


def places(rows: int = 4, columns: int = 15) -> np.ndarray:
    """Strips 50 m apart with an image every 20 m, 100 m up; a little uneven, as flights are."""
    x, y = np.meshgrid(20.0 * np.arange(columns), 50.0 * np.arange(rows))
    flat = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 100.0)])
    return flat + np.random.default_rng(0).normal(0.0, 0.5, flat.shape)


def shots_at(enu: np.ndarray, sigma_m: float | None, noise_m: float = 0.0) -> dict[int, Shot]:
    noisy = enu + np.random.default_rng(1).normal(0.0, noise_m, enu.shape)
    shots = {}
    for index, (lat, lon, height) in enumerate(ORIGIN.to_geographic(noisy)):
        fix = GpsFix(float(lat), float(lon), float(height), "ellipsoidal", sigma_m, sigma_m)
        name = f"{index}.JPG"
        shots[index] = Shot(name, Path(name), 400, 300, "k", 0.7, 0.02, "guess", time_s=2.0 * index, gps=fix)
    return shots


def bowl(enu: np.ndarray, sag_m: float) -> np.ndarray:
    """Raise places by sag_m at 100 m from the middle."""
    offset = enu[:, :2] - enu[:, :2].mean(axis=0)
    return enu + np.column_stack([np.zeros((len(enu), 2)), sag_m * (offset**2).sum(axis=1) / 100.0**2])


def map_of(work: Path, enu: np.ndarray, per_submap: int = 5) -> MapState:
    """A map whose cameras are at ENU places, in submaps with frames of their own."""
    state = MapState(Store(work))
    for number, start in enumerate(range(0, len(enu), per_submap)):
        rng = np.random.default_rng(number)
        pose = Sim3(float(np.exp(rng.normal())), rotation_exp(rng.normal(size=3)), rng.normal(size=3))
        frames = []
        for index in range(start, min(start + per_submap, len(enu))):
            in_map = MAP_FROM_ENU.apply_to_pose(Rigid3(NADIR, enu[index]))
            frames.append(Frame(index, number, CAMERA, PixelMap(1.0, 1.0), pose.inverse().apply_to_pose(in_map), 1.0))
        state.commit(Submap(number, pose, tuple(frames), ()), [])
    return state


def tie_of(state: MapState, shots: dict[int, Shot]) -> GpsTie:
    tie = tie_to_positions(state, shots, OPTIONS)
    assert tie is not None
    return tie


def distances_m(state: MapState, tie: GpsTie, enu: np.ndarray) -> np.ndarray:
    """From cameras to their true places, by the tie; the tie's own origin is at the median position."""
    centres = tie.enu_from_map.apply(np.array([state.map_from_cam(i).translation for i in state.frames]))
    offset = tie.positions.frame.from_geographic(ORIGIN.to_geographic(enu)) - centres
    return np.asarray(np.linalg.norm(offset, axis=1))


def test_the_tie_is_the_similarity_to_the_positions(tmp_path: Path) -> None:
    enu = places()
    state = map_of(tmp_path, enu)
    tie = tie_of(state, shots_at(enu, RTK_M, RTK_M))
    assert distances_m(state, tie, enu).max() < 0.1
    assert tie.enu_from_map.scale == pytest.approx(100.0, rel=1e-3)
    assert tie.noise_m == pytest.approx(RTK_M, rel=0.6)


@pytest.mark.parametrize("case", ["few", "line", "none", "cluster", "nonsense"])
def test_positions_that_cannot_say_enough_give_no_tie(tmp_path: Path, case: str) -> None:
    enu = {"few": places()[:11], "line": places(1, 40), "cluster": 0.1 * places()}.get(case, places())
    shots = shots_at(enu, CONSUMER_M if case == "cluster" else RTK_M)
    if case == "none":
        shots = {i: replace(shot, gps=None) for i, shot in shots.items()}
    if case == "nonsense":
        shots = shots_at(np.random.default_rng(5).permutation(enu), RTK_M)
    assert tie_to_positions(map_of(tmp_path, enu), shots, OPTIONS) is None


def test_priors_take_the_bend_out_of_a_map(tmp_path: Path) -> None:
    enu = places()
    state = map_of(tmp_path, bowl(enu, 1.5))
    shots = shots_at(enu, RTK_M, RTK_M)
    tie = tie_of(state, shots)
    before = distances_m(state, tie, enu)
    state.move_submaps({p.submap: p.map_from_submap for p in pose_priors(state, tie, shots)}, {}, {})
    after = distances_m(state, tie, enu)
    assert before.max() > 1.5 and after.max() < 0.35  # what is bent within a submap stays


def test_a_straight_map_is_left_alone(tmp_path: Path) -> None:
    enu = places()
    state, shots = map_of(tmp_path, enu), shots_at(enu, RTK_M)
    for prior in pose_priors(state, tie_of(state, shots), shots):
        off = state.map_from_submap[prior.submap].inverse() @ prior.map_from_submap
        assert rotation_angle_deg(off.rotation) < 0.05 and abs(np.log(off.scale)) < 1e-3


def test_positions_do_not_tell_the_roll_of_a_strip(tmp_path: Path) -> None:
    """Five cameras all but on a line, whose local model is less accurate than their positions."""
    enu = places()
    state = map_of(tmp_path, enu + np.random.default_rng(2).normal(0.0, 0.15, enu.shape))
    shots = shots_at(enu, RTK_M)
    turns = []
    for prior in pose_priors(state, tie_of(state, shots), shots):
        off = state.map_from_submap[prior.submap].inverse() @ prior.map_from_submap
        turns.append(rotation_angle_deg(off.rotation))
        values = np.linalg.eigvalsh(prior.information)
        assert values[0] < 1e-9 * values[-1]  # one direction is open
    assert max(turns) < 2.0


def test_a_wrong_position_within_a_submap_counts_little(tmp_path: Path) -> None:
    enu = places()
    wrong = enu.copy()
    wrong[32, 0] += 40.0
    state, shots = map_of(tmp_path, enu), shots_at(wrong, RTK_M, RTK_M)
    tie = tie_of(state, shots)
    state.move_submaps({p.submap: p.map_from_submap for p in pose_priors(state, tie, shots)}, {}, {})
    assert np.delete(distances_m(state, tie, enu), 32).max() < 1.0


def test_information_follows_the_accuracy_and_heights_must_state_theirs(tmp_path: Path) -> None:
    enu = places()
    state = map_of(tmp_path, enu)

    def position_information(shots: dict[int, Shot]) -> np.ndarray:
        """Of the place of the submap's first camera, in ENU, 1 / m2."""
        tie = tie_of(state, shots)
        prior = pose_priors(state, tie, shots)[3]
        pose, point = prior.map_from_submap, state.frames[15].submap_from_cam.translation
        cross = np.array([[0, -point[2], point[1]], [point[2], 0, -point[0]], [-point[1], point[0], 0]])
        jacobian = tie.enu_from_map.scale * tie.enu_from_map.rotation @ pose.rotation * pose.scale
        jacobian = jacobian @ np.column_stack([-cross, np.eye(3), point])
        covariance = jacobian @ np.linalg.pinv(prior.information, rcond=1e-12, hermitian=True) @ jacobian.T
        return 1.0 / np.diag(covariance)

    precise, coarse = (position_information(shots_at(enu, sigma)) for sigma in (0.1, 1.0))
    np.testing.assert_allclose(precise / coarse, 100.0, rtol=0.2)
    consumer = shots_at(enu, None)  # taken for 3 m and 5 m, and heights not at all
    tie = tie_of(state, consumer)
    up = tie.enu_from_map.rotation.T[:, 2]
    for prior in pose_priors(state, tie, consumer):
        lift = np.zeros(7)
        lift[3:6] = prior.map_from_submap.rotation.T @ up
        sideways = np.zeros(7)
        sideways[3:6] = prior.map_from_submap.rotation.T @ tie.enu_from_map.rotation.T[:, 0]
        assert lift @ prior.information @ lift < 1e-6 * (sideways @ prior.information @ sideways)


def test_one_image_in_a_submap_determines_its_place_only(tmp_path: Path) -> None:
    enu = places()
    state, shots = map_of(tmp_path, enu, per_submap=1), shots_at(enu, RTK_M)
    for prior in pose_priors(state, tie_of(state, shots), shots):
        assert np.linalg.matrix_rank(prior.information, tol=1e-9 * np.abs(prior.information).max()) == 3
        assert np.isfinite(prior.information).all() and prior.map_from_submap.scale > 0.0


def test_submaps_at_one_place_stay_finite(tmp_path: Path) -> None:
    enu = places()
    frozen = enu.copy()
    frozen[10:20] = frozen[10]  # the receiver stood still
    state, shots = map_of(tmp_path, enu), shots_at(frozen, RTK_M)
    for prior in pose_priors(state, tie_of(state, shots), shots):
        assert 1e-3 < prior.map_from_submap.scale / state.map_from_submap[prior.submap].scale < 1e3
        assert np.isfinite(prior.information).all()


def disagreement(tie: GpsTie, shots: dict[int, Shot], enu: np.ndarray, at: np.ndarray, drift: np.ndarray) -> float:
    references = {i: MAP_FROM_ENU.apply(enu[i] + drift) for i in (20, 21, 35, 36)}
    return gps_disagreement(22, MAP_FROM_ENU.apply(at + drift), references, shots, tie)


@pytest.mark.parametrize("sigma_m", [RTK_M, CONSUMER_M])
def test_an_image_far_from_its_position_is_doubted(tmp_path: Path, sigma_m: float) -> None:
    enu = places()
    shots = shots_at(enu, sigma_m, 0.3)
    tie = tie_of(map_of(tmp_path, enu), shots)
    still, drift = np.zeros(3), np.array([8.0, -5.0, 20.0])
    for moved_by in (still, drift):  # drift of the map here is no fault of the image
        assert disagreement(tie, shots, enu, enu[22], moved_by) < 0.3
        assert disagreement(tie, shots, enu, enu[22] + [0.0, 40.0, 0.0], moved_by) > 1.0
    assert disagreement(tie, shots, enu, enu[22] + [0.0, 0.0, 40.0], still) < 0.3  # heights have no vote


def test_without_a_position_there_is_no_vote(tmp_path: Path) -> None:
    enu = places()
    shots = shots_at(enu, RTK_M)
    tie = tie_of(map_of(tmp_path, enu), shots)
    nowhere = enu[22] + [0.0, 40.0, 0.0]
    for silent in ((22,), (20, 21, 35, 36)):
        fewer = {i: replace(shot, gps=None) if i in silent else shot for i, shot in shots.items()}
        assert disagreement(tie, fewer, enu, nowhere, np.zeros(3)) == 0.0
