"""Bends of local models: their form against the oracle's, and how well the pose graph finds and removes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.transforms import Rigid3, Sim3, nearest_rotation, rotation_angle_deg, rotation_exp
from onthefly3r.graph import posegraph
from onthefly3r.graph.bending import FORMS, Bending, _most_likely, estimate, found_so_far, sheet
from onthefly3r.graph.gpsprior import _prior
from onthefly3r.graph.posegraph import default_solver, optimise_submaps
from onthefly3r.graph.sightings import FRAMES, ViewNoise, shared_sightings
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.records import Frame, Sighting, Submap
from onthefly3r.simulate.bends import Bend

CAMERA = Camera(56, 42, 38.0, 38.0, 28.0, 21.0)
DOWN = np.diag([1.0, -1.0, -1.0])
HEIGHT = 1.0  # of the cameras above the ground; all lengths in this unit
NOISE = ViewNoise(0.0015, 0.0017, 0.002)  # of the oracle's views, as it is by default
SPREAD = 0.03  # of curvatures
STEP = 0.3
MODELS = 16
ROOT = np.eye(3)[None] / 0.0003  # whitens positions


def camera(x: float, y: float, tilt_rad: float = 0.0) -> Rigid3:
    """A camera that looks down, tilted about x."""
    return Rigid3(rotation_exp(np.array([tilt_rad, 0.0, 0.0])) @ DOWN, np.array([x, y, HEIGHT]))


GRID = [camera(STEP * x, STEP * y) for x in range(5) for y in range(4)]


def bend(poses: list[Rigid3], curvatures: np.ndarray) -> Bend:
    """The oracle's bend about the middle of some cameras; a sag is c r^2 / 2 at r = 1."""
    middle = np.mean([pose.translation for pose in poses], axis=0)
    return Bend(middle, 0.5 * np.tensordot(curvatures, FORMS, 1), 1.0)


def enu_curvatures(curvatures: np.ndarray, enu_axes: np.ndarray) -> np.ndarray:
    """Curvatures (3,) about a sheet's axes as those about east and north."""
    turned = enu_axes[:2, :2].T @ np.tensordot(curvatures, FORMS, 1) @ enu_axes[:2, :2]
    return np.array([turned[0, 0] + turned[1, 1], turned[0, 0] - turned[1, 1], 2.0 * turned[0, 1]]) / 2.0


@pytest.mark.parametrize("curvatures", 0.01 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1, -1, 1]]))
def test_cameras_of_a_bent_model_are_straightened(curvatures: np.ndarray) -> None:
    """Each bent camera back to where it was, to second order; seen in a frame of its own."""
    submap_from_enu = Sim3(0.4, rotation_exp(np.array([0.3, -0.8, 1.9])), np.array([5.0, -2.0, 1.0]))
    bent = [submap_from_enu.apply_to_pose(bend(GRID, curvatures).apply_to_pose(pose)) for pose in GRID]
    found = sheet(bent, 0.4 * HEIGHT)
    np.testing.assert_allclose(found.axes[2], submap_from_enu.rotation[:, 2], atol=2e-3)
    np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-12)
    assert found.height == pytest.approx(0.4 * HEIGHT, rel=1e-3)
    # The curvatures about the axes of the sheet: those about east and north, turned; FORMS are orthogonal.
    enu_axes = found.axes @ submap_from_enu.rotation
    turned = enu_axes[:2, :2] @ np.tensordot(curvatures, FORMS, 1) @ enu_axes[:2, :2].T
    own = np.einsum("kij,ij->k", FORMS, turned) / 2.0 / 0.4
    straight = [found.straighten(pose.translation, own).apply_to_pose(pose) for pose in bent]
    truth = [submap_from_enu.apply_to_pose(pose) for pose in GRID]
    turns = {
        name: max(rotation_angle_deg(a.rotation @ b.rotation.T) for a, b in zip(poses, truth, strict=True))
        for name, poses in (("bent", bent), ("straight", straight))
    }
    # A bend is about the middle, which it leaves or lifts by what all cameras share.
    shifts = {
        name: np.ptp([a.translation - b.translation for a, b in zip(poses, truth, strict=True)], axis=0).max()
        for name, poses in (("bent", bent), ("straight", straight))
    }
    assert turns["bent"] > 0.3 and shifts["bent"] > 0.001
    assert turns["straight"] < 0.03 * turns["bent"]
    assert shifts["straight"] < 0.06 * shifts["bent"]


def test_cameras_oblique_to_four_sides_are_as_high_as_they_are() -> None:
    tilts = [np.array(axis) * 0.7 for axis in ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))]
    poses = [Rigid3(rotation_exp(tilts[k % 4]) @ DOWN, pose.translation) for k, pose in enumerate(GRID)]
    assert sheet(poses, HEIGHT / np.cos(0.7)).height == pytest.approx(HEIGHT, rel=0.01)


def test_a_camera_higher_up_shifts_the_more() -> None:
    curvatures = np.array([0.01, 0.0, 0.0])
    places = [(x, y) for x in range(4) for y in range(4)]
    poses = [Rigid3(DOWN, np.array([STEP * x, STEP * y, HEIGHT + 0.5 * ((x + y) % 2)])) for x, y in places]
    found = sheet(poses, float(np.mean([p.translation[2] for p in poses])))
    bent = bend(poses, np.array([0.01, 0.0, 0.0]))
    wrong = [
        found.straighten(b.translation, curvatures).apply(b.translation) - p.translation
        for p, b in ((p, bent.apply_to_pose(p)) for p in poses)
    ]
    assert np.ptp(wrong, axis=0).max() < 3e-4  # 3e-3 if all were as high as their middle


def test_up_is_square_to_the_plane_of_oblique_cameras() -> None:
    found = sheet([camera(p.translation[0], p.translation[1], tilt_rad=0.7) for p in GRID], HEIGHT / np.cos(0.7))
    assert np.degrees(np.arccos(found.axes[2][2])) < 2.0
    assert found.height == pytest.approx(HEIGHT, rel=0.03)


@pytest.mark.parametrize("poses", [[camera(STEP * k, 0.0) for k in range(6)], [camera(0.0, 0.0)]])
def test_up_of_a_strip_and_of_one_camera_is_where_they_do_not_look(poses: list[Rigid3]) -> None:
    np.testing.assert_allclose(sheet(poses, HEIGHT).axes[2], [0.0, 0.0, 1.0], atol=1e-9)


def survey(work: Path, seed: int, curvatures: np.ndarray, unit: float = 1.0) -> tuple[MapState, dict[int, Rigid3]]:
    """A map of 16 overlapping local models of 4 x 4 cameras, bent by (16, 3), each view with `NOISE`; and the truth.

    Each model is where it belongs, and takes in anew those of its cameras that earlier ones hold.
    """
    rng = np.random.default_rng(seed)
    state = MapState(Store(work))
    first_of: dict[tuple[int, int], tuple[int, Sim3]] = {}
    truth: dict[int, Rigid3] = {}
    for number, (x, y) in enumerate((2 * i, 2 * j) for i in range(4) for j in range(4)):
        places = [(x + i, y + j) for i in range(4) for j in range(4)]
        poses = [camera(STEP * i, STEP * j) for i, j in places]
        bent = bend(poses, curvatures[number])
        scale = float(np.exp(0.1 * rng.standard_normal()))
        submap_from_enu = Sim3(scale, rotation_exp(rng.standard_normal(3)), rng.standard_normal(3))
        frames, sightings = [], []
        for place, pose in zip(places, poses, strict=True):
            there = bent.apply_to_pose(pose)
            turn = there.rotation @ pose.rotation.T
            bent_from_enu = Sim3(1.0, turn, there.translation - turn @ pose.translation)
            about = Sim3(1.0, np.eye(3), pose.translation)
            noise = Sim3(
                float(np.exp(NOISE.log_scale * rng.standard_normal())),
                rotation_exp(NOISE.rotation_rad * rng.standard_normal(3)),
                NOISE.position * rng.standard_normal(3),
            )
            view_from_enu = submap_from_enu @ bent_from_enu @ about @ noise @ about.inverse()
            cam = view_from_enu.apply_to_pose(pose)
            if place not in first_of:
                index = len(first_of)
                first_of[place], truth[index] = (index, view_from_enu), pose
                frames.append(Frame(index, number, CAMERA, PixelMap(1.0, 1.0), cam, scale * HEIGHT))
            else:
                index, first_from_enu = first_of[place]
                sightings.append(Sighting(index, number, first_from_enu @ view_from_enu.inverse(), cam))
        map_from_submap = Sim3(unit, np.eye(3), np.zeros(3)) @ submap_from_enu.inverse()
        state.commit(Submap(number, map_from_submap, tuple(frames), tuple(sightings)), [])
    state.set_spacing(0.01 * unit)
    return state, truth


def drawn(seed: int) -> np.ndarray:
    """Curvatures (16, 3) of the models, without what they have in common, which shows in no disagreement."""
    values = np.random.default_rng(100 + seed).standard_normal((MODELS, 3))
    return np.asarray(SPREAD * (values - values.mean(axis=0)))


def found_in_enu(state: MapState, unit: float = 1.0) -> np.ndarray:
    """Curvatures (16, 3) found, about east and north; the map is level and its axes are these."""
    bending, found = found_so_far(state), []
    for number, pose in sorted(state.map_from_submap.items()):
        enu_axes = bending.sheet_of[number].axes @ pose.rotation.T
        found.append(enu_curvatures(bending.curvatures_of[number] / pose.scale * unit, enu_axes))
    return np.array(found)


@pytest.mark.parametrize("unit", [1.0, 40.0])
def test_the_graph_finds_how_each_model_is_bent(tmp_path: Path, unit: float) -> None:
    """Whatever the map's unit."""
    state, _ = survey(tmp_path, 1, drawn(1), unit)
    optimise_submaps(state, default_solver())
    found = found_in_enu(state, unit)
    for form in range(3):
        assert np.corrcoef(found[:, form], drawn(1)[:, form])[0, 1] > 0.9
        assert np.std(found[:, form] - drawn(1)[:, form]) < 0.5 * SPREAD


def test_models_that_are_not_bent_stay_as_they_are(tmp_path: Path) -> None:
    found = []
    for seed in range(3):
        state, _ = survey(tmp_path / str(seed), seed, np.zeros((MODELS, 3)))
        optimise_submaps(state, default_solver())
        found.append(found_in_enu(state))
    # Turns of the outermost cameras, 0.6 from the middle, far below the noise of one view.
    assert np.sqrt(np.mean(np.square(found))) * 0.6 < 0.1 * NOISE.rotation_rad


def test_what_is_told_is_shrunk_by_how_widely_each_kind_is_drawn() -> None:
    """Bowls of spread 2 and no saddles, each told with an error of 1: the mean given the data is known."""
    rng = np.random.default_rng(5)
    true = rng.standard_normal((4000, 3)) * (2.0, 0.0, 0.0)
    told = true + rng.standard_normal((4000, 3))
    information = np.broadcast_to(np.eye(3), (4000, 3, 3))
    found = _most_likely(information, told)
    np.testing.assert_allclose(found[:, 0], told[:, 0] * 4.0 / 5.0, atol=0.15)
    assert np.abs(found[:, 1:] / told[:, 1:]).max() < 0.2  # on its way to 0


def test_views_placed_wrong_do_not_bend_their_model(tmp_path: Path) -> None:
    """Every tenth view that is seen again is 0.2 rad and a flying height off."""
    found = {}
    for wrong in (False, True):
        state, _ = survey(tmp_path / str(wrong), 6, drawn(6))
        if wrong:
            off = Sim3(1.0, rotation_exp(np.array([0.2, 0.0, 0.0])), np.array([1.0, 0.0, 0.0]))
            state.sightings[::10] = [
                replace(seen, frame_from_submap=seen.frame_from_submap @ off) for seen in state.sightings[::10]
            ]
        optimise_submaps(state, default_solver())
        found[wrong] = np.sqrt(np.mean(np.square(found_in_enu(state) - drawn(6))))
    assert found[True] < 2.0 * found[False]


def test_a_strip_that_registration_has_just_left_is_not_bent_for_it(tmp_path: Path) -> None:
    """Each model where the frames of earlier ones put it: most misfits are nil, and tell of no noise before a pass."""
    whole, _ = survey(tmp_path / "whole", 7, np.zeros((MODELS, 3)))
    state = MapState(Store(tmp_path / "strip"))
    for number in range(4):  # the first row: models 0 to 3 follow one another
        frames = tuple(frame for frame in whole.frames.values() if frame.submap == number)
        seen = tuple(seen for seen in whole.sightings if seen.submap == number)
        pose = (
            whole.map_from_submap[0] if number == 0 else state.submap_pose_of(seen[0].frame) @ seen[0].frame_from_submap
        )
        state.commit(Submap(number, pose, frames, seen), [])
    state.set_spacing(0.01)
    found = []

    def spied(*known: Any) -> Bending:
        found.append(estimate(*known))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(posegraph, "estimate", spied)
        optimise_submaps(state, default_solver())
    assert len(found) == posegraph.ROUNDS
    assert max(np.abs(list(bending.curvatures_of.values())).max() for bending in found) < 0.1 * SPREAD


def test_positions_of_bent_models_hold_the_map_where_it_is_straight(tmp_path: Path) -> None:
    """Each model is known from its own new cameras alone, which lie to one side of its middle."""
    errors = []
    for told in (True, False):
        state, truth = survey(tmp_path / str(told), 8, drawn(8))
        priors = []
        for number, pose in state.map_from_submap.items():
            own = [frame for frame in state.frames.values() if frame.submap == number]
            centres = np.array([frame.submap_from_cam.translation for frame in own])
            fitted = _prior(number, pose, centres, np.array([truth[f.index].translation for f in own]), ROOT)
            if fitted is not None:
                priors.append(fitted if told else replace(fitted, middle=found_so_far(state).sheet_of[number].middle))
        optimise_submaps(state, default_solver(), priors)
        errors.append(turned_rms_rad(state, truth))
    assert errors[0] < 0.8 * errors[1]


def turned_rms_rad(state: MapState, truth: dict[int, Rigid3]) -> float:
    """Rotations against the truth after the best common rotation."""
    turns = [state.map_from_cam(i).rotation @ truth[i].rotation.T for i in truth]
    common = nearest_rotation(np.sum(turns, axis=0))
    return float(np.sqrt(np.mean([np.radians(rotation_angle_deg(turn @ common.T)) ** 2 for turn in turns])))


def test_a_map_of_bent_models_comes_out_straighter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    errors: dict[int, list[float]] = {0: [], posegraph.ROUNDS: []}
    for rounds, found in errors.items():
        monkeypatch.setattr(posegraph, "ROUNDS", rounds)
        for seed in range(3):
            state, truth = survey(tmp_path / f"{seed} {rounds}", seed, drawn(seed))
            optimise_submaps(state, default_solver())
            found.append(turned_rms_rad(state, truth))
    as_they_are, straightened = (np.mean(found) for found in errors.values())
    assert straightened < 0.6 * as_they_are


def test_what_was_found_stays_with_the_map(tmp_path: Path) -> None:
    state, _ = survey(tmp_path, 2, drawn(2))
    optimise_submaps(state, default_solver())
    again = MapState.load(Store(tmp_path))
    before, after = found_so_far(state), found_so_far(again)
    for number in state.map_from_submap:
        np.testing.assert_array_equal(after.curvatures_of[number], before.curvatures_of[number])
        np.testing.assert_array_equal(after.sheet_of[number].axes, before.sheet_of[number].axes)
    for index in state.frames:
        np.testing.assert_allclose(
            again.map_from_cam(index).matrix(), state.map_from_cam(index).matrix(), rtol=0.0, atol=1e-12
        )


def test_one_frame_in_common_tells_nothing_of_a_bend(tmp_path: Path) -> None:
    state, _ = survey(tmp_path, 3, drawn(3))
    nodes = state.map_from_submap | {FRAMES + s.frame: state.submap_pose_of(s.frame) for s in state.sightings}
    found: Bending = estimate(nodes, shared_sightings(state)[:1], found_so_far(state), 1e-9)
    np.testing.assert_array_equal(list(found.curvatures_of.values()), np.zeros((MODELS, 3)))
