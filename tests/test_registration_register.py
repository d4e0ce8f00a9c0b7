"""One local model against the map: what may enter, what is refused, and with which numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.geometry.transforms import Sim3, rotation_angle_deg, rotation_exp
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.options import RegistrationOptions
from onthefly3r.records import Frame, LocalModel, NewFrame, Rejection, Submap, Subset
from onthefly3r.registration.references import compact_reference, scene_spacing
from onthefly3r.registration.register import Registration, check_seed, frame_edges, register, seed_edges
from synthetic_models import MAP_FROM_LOCAL, local_model, misplaced, moved, true_view, world_from_cam

OPTIONS = RegistrationOptions()
REFERENCES, NEW = (0, 1, 2, 5, 6, 7), (3, 8, 11)
SUBSET = Subset(REFERENCES, NEW)
# Two submaps, each in a frame of its own; the map is the world.
MAP_FROM_SUBMAP = {
    0: Sim3(50.0, rotation_exp(np.array([0.3, 0.2, -0.5])), np.array([10.0, 20.0, 5.0])),
    1: Sim3(120.0, rotation_exp(np.array([-0.1, 0.9, 0.4])), np.array([-7.0, 3.0, 1.0])),
}
MEMBERS = {0: (0, 1, 2), 1: (5, 6, 7)}


@pytest.fixture
def state(tmp_path: Path) -> MapState:
    state = MapState(Store(tmp_path))
    for number, members in MEMBERS.items():
        frames = []
        for index in members:
            view = moved(true_view(index, 0.1, np.random.default_rng(index)), MAP_FROM_SUBMAP[number].inverse())
            frame = Frame(index, number, view.camera, view.grid_from_photo, view.local_from_cam, 1.0)
            empty = np.zeros((0, 3), np.float32)
            reference = compact_reference(view, 400, 0.5)
            frames.append(NewFrame(frame, reference, empty, empty.astype(np.uint8), np.zeros(0, np.uint8)))
        submap = Submap(number, MAP_FROM_SUBMAP[number], tuple(new.frame for new in frames), ())
        state.commit(submap, frames)
    state.set_spacing(scene_spacing({0: true_view(0)}, 0.5))
    return state


def registered(state: MapState, model: LocalModel, options: RegistrationOptions = OPTIONS) -> Registration:
    outcome = register(model, SUBSET, state, 0.5, options)
    assert isinstance(outcome, Registration), outcome
    return outcome


def test_a_sound_model_is_placed_where_it_belongs(state: MapState) -> None:
    outcome = registered(state, local_model(SUBSET.members))
    assert outcome.accepted == NEW and not outcome.refused and not outcome.pruned
    found = outcome.alignment.map_from_local
    for index in NEW:
        placed = found.apply(MAP_FROM_LOCAL.inverse().apply(world_from_cam(index).translation))
        assert np.linalg.norm(placed - world_from_cam(index).translation) < 0.2


def test_references_are_seen_again_where_they_are(state: MapState) -> None:
    model = local_model(SUBSET.members)
    sightings = registered(state, model).sightings
    assert [seen.frame for seen in sightings] == list(REFERENCES) and all(seen.submap == 2 for seen in sightings)
    for seen in sightings:
        source = state.frames[seen.frame].submap
        true = MAP_FROM_SUBMAP[source].inverse() @ MAP_FROM_LOCAL
        off = true.inverse() @ seen.frame_from_submap
        assert rotation_angle_deg(off.rotation) < 0.5 and abs(np.log(off.scale)) < 0.01
        np.testing.assert_array_equal(seen.submap_from_cam.matrix(), model.views[seen.frame].local_from_cam.matrix())


def test_a_reference_that_was_moved_is_seen_in_the_frame_of_its_points(state: MapState) -> None:
    """Where a frame is in the map does not change how its stored points lie in the new submap."""
    model = local_model(SUBSET.members)
    before = registered(state, model).sightings
    state.move_submaps({}, {6: Sim3(1.0, np.eye(3), np.array([0.3, 0.0, 0.0])) @ state.submap_pose_of(6)}, {})
    after = registered(state, model).sightings
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other.frame_from_submap.matrix(), one.frame_from_submap.matrix(), atol=1e-6)


@pytest.mark.parametrize("bad", [(5,), (5, 1)])
def test_bad_references_are_pruned_and_not_seen_again(state: MapState, bad: tuple[int, ...]) -> None:
    model = local_model(SUBSET.members, bad={i: misplaced(i, 30.0, 40.0) for i in bad})
    outcome = registered(state, model)
    assert set(outcome.pruned) == set(bad) and outcome.accepted == NEW
    assert not set(bad) & set(outcome.alignment.references)
    assert not set(bad) & {seen.frame for seen in outcome.sightings}
    only_bad_one = registered(state, local_model(SUBSET.members, bad={i: misplaced(i, 30.0, 40.0) for i in (0, 1, 2)}))
    assert {seen.frame for seen in only_bad_one.sightings} == {5, 6, 7}


def test_a_bad_new_image_is_refused_and_the_others_come_along(state: MapState) -> None:
    outcome = registered(state, local_model(SUBSET.members, bad={8: misplaced(8, 30.0, 40.0)}))
    assert outcome.accepted == (3, 11)
    (refused,) = outcome.refused
    assert (refused.images, refused.stage) == ((8,), "queries")
    assert refused.numbers["agreeing_share"] < 1.0 and refused.numbers["overlap_points"] >= 0


def test_a_slightly_bad_image_is_refused_because_the_references_agree_far_better(state: MapState) -> None:
    """8 m and 3 degrees off: within the 6 % of the absolute gate."""
    model = local_model(SUBSET.members, bad={8: misplaced(8, 4.0, 8.0, seed=1)})
    outcome = registered(state, model)
    assert [r.reason for r in outcome.refused] == ["its depth disagrees with the map more than the references' does"]
    loose = registered(state, model, replace(OPTIONS, validate_queries=False))
    assert loose.accepted == NEW


def test_images_that_the_backbone_left_out_are_refused(state: MapState) -> None:
    model = local_model((*REFERENCES, 3, 8))
    outcome = registered(state, model)
    assert outcome.accepted == (3, 8)
    assert [(r.images, r.stage) for r in outcome.refused] == [((11,), "backbone")]
    nothing = register(local_model(REFERENCES), SUBSET, state, 0.5, OPTIONS)
    assert isinstance(nothing, Rejection) and nothing.images == NEW and nothing.stage == "backbone"


def test_rejections_name_all_new_images_and_leave_the_map_alone(state: MapState) -> None:
    before = {i: state.map_from_cam(i).matrix() for i in state.frames}
    journal = (state._store._journal).read_bytes()
    bad = {i: misplaced(i, 40.0, 60.0, seed=i) for i in (0, 1, 2, 5, 6)}
    for model in (local_model(SUBSET.members, bad=bad), local_model((0, 1, *NEW))):
        outcome = register(model, SUBSET, state, 0.5, OPTIONS)
        assert isinstance(outcome, Rejection)
        assert outcome.images == NEW and outcome.stage == "references" and outcome.reason
        assert outcome.numbers["references"] >= 2
    assert register(local_model(NEW), SUBSET, state, 0.5, OPTIONS).stage == "references"  # type: ignore[union-attr]
    assert all((state.map_from_cam(i).matrix() == before[i]).all() for i in before)
    assert state._store._journal.read_bytes() == journal and list(state.frames) == [0, 1, 2, 5, 6, 7]


def test_a_batch_of_bad_images_only_is_a_rejection(state: MapState) -> None:
    bad = {i: misplaced(i, 30.0, 40.0) for i in NEW}
    outcome = register(local_model(SUBSET.members, bad=bad), SUBSET, state, 0.5, OPTIONS)
    assert isinstance(outcome, Rejection) and outcome.images == NEW and outcome.stage == "queries"


def test_positions_have_a_say_only_where_the_depth_agrees(state: MapState) -> None:
    asked = []

    def far(index: int, centre: np.ndarray, references: object) -> float:
        asked.append(index)
        assert np.linalg.norm(centre - world_from_cam(index).translation) < 1.0
        assert set(references) == set(REFERENCES)  # type: ignore[call-overload]
        return 1.7 if index == 3 else 0.4

    model = local_model(SUBSET.members, bad={8: misplaced(8, 30.0, 40.0)})
    outcome = register(model, SUBSET, state, 0.5, OPTIONS, far)
    assert isinstance(outcome, Registration) and outcome.accepted == (11,) and asked == [3, 11]
    reasons = {r.images[0]: r for r in outcome.refused}
    assert reasons[3].reason == "lands far from its position" and reasons[3].numbers["position_offset"] == 1.7


def test_without_validation_everything_enters(state: MapState) -> None:
    bad = {i: misplaced(i, 30.0, 40.0) for i in (0, 5, 8)}
    outcome = registered(state, local_model(SUBSET.members, bad=bad), replace(OPTIONS, validation=False))
    assert outcome.accepted == NEW and not outcome.pruned
    assert set(outcome.alignment.references) == set(REFERENCES)


def test_a_seed_drops_what_contradicts_the_rest() -> None:
    indices = (0, 1, 2, 3, 5, 6, 7, 8, 10, 11, 12, 13)
    assert check_seed(local_model(indices).views, 0.5) == {}
    bad = {i: misplaced(i, 30.0, 40.0) for i in (2, 6, 11)}
    refused = check_seed(local_model(indices, bad=bad).views, 0.5)
    assert set(refused) == {2, 6, 11}
    for index, rejection in refused.items():
        assert rejection.images == (index,) and rejection.stage == "seed" and rejection.numbers


def test_frame_edges_of_the_papers_graph(state: MapState) -> None:
    outcome = registered(state, local_model(SUBSET.members))
    retrieved = {3: [2, 1], 8: [7, 6], 11: [6]}
    edges = frame_edges(local_model(SUBSET.members), outcome, retrieved, state)
    kinds = {kind: [(e.source, e.target) for e in edges if e.kind == kind] for kind in ("ref", "batch", "cont")}
    assert set(kinds["ref"]) == {(r, q) for r in REFERENCES for q in NEW}
    assert kinds["batch"] == [(3, 8), (3, 11), (8, 11)]
    assert kinds["cont"] == [(2, 3), (7, 8)]  # the one that arrived before 11 is not in the map
    for e in edges:  # map units: the world's metres
        true = world_from_cam(e.source).inverse() @ world_from_cam(e.target)
        assert np.linalg.norm(e.source_from_target.translation - true.translation) < 0.3
        assert rotation_angle_deg(e.source_from_target.rotation @ true.rotation.T) < 0.2
        assert 0.0 < e.sigma_translation < 1.0 and e.sigma_rotation_rad > 0.0


def test_a_seed_has_an_edge_between_every_two_of_its_frames() -> None:
    model = local_model(SUBSET.members)
    edges = seed_edges(model.views, SUBSET.members, 0.5)
    members = SUBSET.members
    assert [(e.source, e.target) for e in edges] == [(a, b) for k, a in enumerate(members) for b in members[k + 1 :]]
    poses = {i: view.local_from_cam for i, view in model.views.items()}
    depths = [view.local_from_cam.inverse().apply(view.points.astype(float))[..., 2] for view in model.views.values()]
    for e in edges:
        assert e.kind == "batch"
        np.testing.assert_allclose((poses[e.source] @ e.source_from_target).matrix(), poses[e.target].matrix())
        assert e.sigma_translation == pytest.approx(e.sigma_rotation_rad * float(np.nanmedian(depths)), rel=0.2)
    precise = edges[0].sigma_rotation_rad
    bad = {i: misplaced(i, 3.0, 2.0) for i in members[::2]}
    vague = seed_edges(local_model(members, bad=bad).views, members, 0.5)[0].sigma_rotation_rad
    assert vague > 2.0 * precise > 0.0


def test_continuity_needs_retrieval_and_plausible_motion(state: MapState, monkeypatch: pytest.MonkeyPatch) -> None:
    model = local_model(SUBSET.members)
    outcome = registered(state, model)

    def continued(retrieved: dict[int, list[int]]) -> list[int]:
        return [e.target for e in frame_edges(model, outcome, retrieved, state) if e.kind == "cont"]

    similar = {3: [2], 8: [7], 11: []}
    assert continued({3: [1], 8: [7], 11: []}) == [8]
    monkeypatch.setattr("onthefly3r.registration.register.MAX_TURN_DEG", 10.0)
    assert continued(similar) == []  # headings differ by 17 degrees
    monkeypatch.setattr("onthefly3r.registration.register.MAX_TURN_DEG", 45.0)
    monkeypatch.setattr("onthefly3r.registration.register.MAX_STEP_RATIO", 0.5)
    assert continued(similar) == []
