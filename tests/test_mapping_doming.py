"""Doming of local models: its form against the oracle's, and how well the pose graph finds and removes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_angle_deg, rotation_exp
from onthefly3r.mapping import posegraph
from onthefly3r.mapping.doming import dish, dishes, estimate, found_so_far
from onthefly3r.mapping.posegraph import default_solver, optimise_submaps
from onthefly3r.mapping.sightings import FRAMES, ViewNoise, shared_sightings
from onthefly3r.mapping.state import MapState
from onthefly3r.mapping.store import Store
from onthefly3r.records import Frame, Sighting, Submap
from onthefly3r.simulate.oracle import Bowl

pytest.importorskip("gtsam")

CAMERA = Camera(56, 42, 38.0, 38.0, 28.0, 21.0)
DOWN = np.diag([1.0, -1.0, -1.0])
HEIGHT = 1.0  # of the cameras above the ground; all lengths in this unit
NOISE = ViewNoise(0.0015, 0.0017, 0.002)  # of the oracle, at its default
STEP = 0.3


def camera(x: float, y: float, tilt: float = 0.0) -> Rigid3:
    """A camera that looks down, tilted about x."""
    return Rigid3(rotation_exp(np.array([tilt, 0.0, 0.0])) @ DOWN, np.array([x, y, HEIGHT]))


GRID = [camera(STEP * x, STEP * y) for x in range(5) for y in range(4)]


def bowl(poses: list[Rigid3], curvature: float) -> Bowl:
    """The oracle's bend about the middle of some cameras; its sag is c r^2 / 2 at r = 1."""
    return Bowl(np.mean([pose.translation for pose in poses], axis=0), 0.5 * curvature, 1.0)


def test_cameras_of_a_bent_model_are_straightened() -> None:
    """Each bent camera back to where it was, to second order; seen in a frame of its own."""
    curvature = 0.01
    submap_from_enu = Sim3(0.4, rotation_exp(np.array([0.3, -0.8, 1.9])), np.array([5.0, -2.0, 1.0]))
    bent = [submap_from_enu.apply_to_pose(bowl(GRID, curvature).apply_to_pose(pose)) for pose in GRID]
    found = dish(bent, 0.4 * HEIGHT)
    np.testing.assert_allclose(found.up, submap_from_enu.rotation[:, 2], atol=1e-6)
    assert found.height == pytest.approx(0.4 * HEIGHT)
    worst = {"bent": [0.0, 0.0], "straight": [0.0, 0.0]}
    middle = submap_from_enu.apply_to_pose(bowl(GRID, curvature).apply_to_pose(camera(0.6, 0.45)))
    truth_middle = submap_from_enu.apply(np.array([0.6, 0.45, HEIGHT]))
    lift = found.straighten(middle.translation, curvature / 0.4).apply(middle.translation) - truth_middle
    for pose, was in zip(bent, GRID, strict=True):
        straight = found.straighten(pose.translation, curvature / 0.4).apply_to_pose(pose)
        truth = submap_from_enu.apply_to_pose(was)
        for name, have, offset in (("bent", pose, 0.0), ("straight", straight, lift)):
            turn = rotation_angle_deg(have.rotation @ truth.rotation.T)
            away = float(np.linalg.norm(have.translation - truth.translation - offset))
            worst[name] = [max(worst[name][0], turn), max(worst[name][1], away)]
    assert worst["bent"][0] > 0.4 and worst["bent"][1] > 0.0025
    assert worst["straight"][0] < 0.02 * worst["bent"][0]
    assert worst["straight"][1] < 0.05 * worst["bent"][1]


def test_up_is_square_to_the_plane_of_oblique_cameras() -> None:
    found = dish([camera(p.translation[0], p.translation[1], tilt=0.7) for p in GRID], HEIGHT / np.cos(0.7))
    assert np.degrees(np.arccos(found.up[2])) < 2.0
    assert found.height == pytest.approx(HEIGHT, rel=0.03)


@pytest.mark.parametrize("poses", [[camera(STEP * k, 0.0) for k in range(6)], [camera(0.0, 0.0)]])
def test_up_of_a_strip_and_of_one_camera_is_where_they_do_not_look(poses: list[Rigid3]) -> None:
    found = dish(poses, HEIGHT)
    np.testing.assert_allclose(found.up, [0.0, 0.0, 1.0], atol=1e-9)


def survey(work: Path, seed: int, curvature: dict[int, float] | float, unit: float = 1.0) -> MapState:
    """A map, in its place, of 16 overlapping local models of 4 x 4 cameras, each bent, each view with `NOISE`.

    A model takes in its own 4 x 4 cameras anew as far as earlier ones hold them.
    """
    rng = np.random.default_rng(seed)
    state = MapState(Store(work))
    view_of: dict[tuple[int, int], tuple[int, Sim3, int]] = {}
    truth: dict[int, Rigid3] = {}
    for number, (x, y) in enumerate((2 * i, 2 * j) for i in range(4) for j in range(4)):
        places = [(x + i, y + j) for i in range(4) for j in range(4)]
        poses = [camera(STEP * i, STEP * j) for i, j in places]
        bend = bowl(poses, curvature if isinstance(curvature, float) else curvature[number])
        submap_from_enu = Sim3(
            float(np.exp(0.1 * rng.standard_normal())), rotation_exp(rng.standard_normal(3)), rng.standard_normal(3)
        )
        frames, sightings = [], []
        for place, pose in zip(places, poses, strict=True):
            about = Sim3(1.0, np.eye(3), pose.translation)
            bent = bend.apply_to_pose(pose)
            turn = bent.rotation @ pose.rotation.T
            bent_from_straight = Sim3(1.0, turn, bent.translation - turn @ pose.translation)
            noise = Sim3(
                float(np.exp(NOISE.log_scale * rng.standard_normal())),
                rotation_exp(NOISE.rotation_rad * rng.standard_normal(3)),
                NOISE.position * rng.standard_normal(3),
            )
            submap_from_scene = submap_from_enu @ bent_from_straight @ about @ noise @ about.inverse()
            submap_from_cam = submap_from_scene.apply_to_pose(pose)
            if place not in view_of:
                view_of[place] = len(view_of), submap_from_scene, number
                truth[view_of[place][0]] = pose
                frames.append(
                    Frame(
                        view_of[place][0],
                        number,
                        CAMERA,
                        PixelMap(1.0, 1.0),
                        submap_from_cam,
                        submap_from_enu.scale * HEIGHT,
                    )
                )
            else:
                index, first, _ = view_of[place]
                sightings.append(Sighting(index, number, first @ submap_from_scene.inverse(), submap_from_cam))
        map_from_submap = Sim3(unit, np.eye(3), np.zeros(3)) @ submap_from_enu.inverse()
        state.commit(Submap(number, map_from_submap, tuple(frames), tuple(sightings)), [])
    state.spacing = 0.01 * unit
    state.truth = truth  # type: ignore[attr-defined]
    return state


def drawn(seed: int, sigma: float) -> dict[int, float]:
    """A curvature for each of the 16 models."""
    values = sigma * np.random.default_rng(100 + seed).standard_normal(16)
    return dict(enumerate(values.tolist()))


def nodes_of(state: MapState) -> dict[int, Sim3]:
    return state.map_from_submap | {FRAMES + s.frame: state.submap_pose_of(s.frame) for s in state.sightings}


def in_map(state: MapState) -> np.ndarray:
    """Curvatures found, per unit of the scene."""
    curvature_of = state.curvature_of
    return np.array([curvature_of[k] / state.map_from_submap[k].scale for k in sorted(state.map_from_submap)])


@pytest.mark.parametrize("unit", [1.0, 40.0])
def test_the_graph_finds_how_much_each_model_is_bent(tmp_path: Path, unit: float) -> None:
    """Whatever the map's unit."""
    true = drawn(1, 0.03)
    state = survey(tmp_path, 1, true, unit)
    optimise_submaps(state, default_solver())
    found = in_map(state) * unit
    wanted = np.array(list(true.values()))
    assert np.corrcoef(found, wanted)[0, 1] > 0.95
    # All alike bends nothing, so that a common part stays open.
    assert np.std(found - wanted) < 0.3 * np.std(wanted)


def test_models_that_are_not_bent_stay_as_they_are(tmp_path: Path) -> None:
    found = []
    for seed in range(3):
        state = survey(tmp_path / str(seed), seed, 0.0)
        optimise_submaps(state, default_solver())
        found.append(in_map(state))
    # A turn of the outermost cameras (0.6 from the middle) far below the noise of one view.
    assert np.sqrt(np.mean(np.square(found))) * 0.6 < 0.5 * NOISE.rotation_rad


def tilt_rms(state: MapState) -> float:
    """Rotations against the truth after the best common rotation, rad."""
    truth: dict[int, Rigid3] = state.truth  # type: ignore[attr-defined]
    turns = [state.map_from_cam(i).rotation @ truth[i].rotation.T for i in truth]
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    return float(np.sqrt(np.mean([np.radians(rotation_angle_deg(turn @ (u @ vt).T)) ** 2 for turn in turns])))


def test_a_map_of_bent_models_comes_out_straighter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    straight, bent = [], []
    for seed in range(3):
        state = survey(tmp_path / f"{seed}", seed, drawn(seed, 0.03))
        optimise_submaps(state, default_solver())
        straight.append(tilt_rms(state))
        with monkeypatch.context() as patch:
            patch.setattr(posegraph, "ROUNDS", 0)
            state = survey(tmp_path / f"{seed} as it is", seed, drawn(seed, 0.03))
            optimise_submaps(state, default_solver())
            bent.append(tilt_rms(state))
    assert np.mean(straight) < 0.6 * np.mean(bent)


def test_what_was_found_stays_with_the_map(tmp_path: Path) -> None:
    state = survey(tmp_path, 2, drawn(2, 0.03))
    optimise_submaps(state, default_solver())
    again = MapState.load(Store(tmp_path))
    assert again.curvature_of == state.curvature_of
    assert found_so_far(again).curvature_of == state.curvature_of
    for index in state.frames:
        np.testing.assert_allclose(again.map_from_cam(index).matrix(), state.map_from_cam(index).matrix(), atol=1e-12)


def test_one_frame_in_common_tells_nothing_of_a_bend(tmp_path: Path) -> None:
    state = survey(tmp_path, 3, 0.05)
    alone = shared_sightings(state)[:1]
    assert set(estimate(nodes_of(state), alone, dishes(state), NOISE).curvature_of.values()) == {0.0}
