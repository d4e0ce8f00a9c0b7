"""Whether a join is believed: depths and looks of all that two fragments would see in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from onthefly3r.geometry.transforms import Sim3, rotation_exp
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.records import Frame, NewFrame, Submap
from onthefly3r.registration.overlap import check_overlap
from onthefly3r.registration.references import compact_reference
from synthetic_models import moved, true_view, world_from_cam

INTO_FROM_SOURCE = Sim3(3.0, rotation_exp(np.array([0.2, -0.7, 1.9])), np.array([40.0, -10.0, 7.0]))
ROWS = {0: range(0, 15), 1: range(15, 30)}  # of five cameras each, 25 m apart: footprints of 117 m by 87 m
LOOKS_M = 40.0  # so far apart, pictures look half as much alike as at the same place


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> MapState:
    """Two fragments side by side: the first in the frame of the world, the other in one of its own."""
    state = MapState(Store(tmp_path_factory.mktemp("map")))
    for number, members in ROWS.items():
        frames = []
        for index in members:
            view = true_view(index, 0.1, np.random.default_rng(index))
            view = view if number == 0 else moved(view, INTO_FROM_SOURCE.inverse())
            frame = Frame(index, number, view.camera, view.grid_from_photo, view.local_from_cam, 1.0)
            empty = np.zeros((0, 3), np.float32)
            told = compact_reference(view, 400, 0.5)
            frames.append(NewFrame(frame, told, empty, empty.astype(np.uint8), np.zeros(0, np.uint8)))
        submap = Submap(number, Sim3(), tuple(new.frame for new in frames), (), fragment=number)
        state.commit(submap, frames)
    return state


def looks(elsewhere: Sequence[int] = ()) -> Callable[[Sequence[int], Sequence[int]], np.ndarray]:
    """Similarities that follow the distance between the cameras; some photographs are of quite another place."""

    def place(index: int) -> np.ndarray:
        return world_from_cam(index).translation + (5000.0 if index in elsewhere else 0.0)

    def similar(first: Sequence[int], second: Sequence[int]) -> np.ndarray:
        apart = np.array([[np.linalg.norm(place(a) - place(b)) for b in second] for a in first])
        return 0.1 + 0.9 * 0.5 ** (apart / LOOKS_M) ** 2

    return similar


def shifted(east_m: float, north_m: float, up_m: float) -> Sim3:
    return Sim3(1.0, np.eye(3), np.array([east_m, north_m, up_m])) @ INTO_FROM_SOURCE


def test_the_true_join_is_believed(state: MapState) -> None:
    verdict = check_overlap(state.part(1), state.part(0), INTO_FROM_SOURCE, looks())
    assert verdict.passed, verdict
    assert verdict.numbers["agreeing_frames"] == 1.0 and verdict.numbers["overlapping_frames"] >= 10
    assert verdict.numbers["unlike_frames"] <= 0.1
    assert check_overlap(state.part(0), state.part(1), INTO_FROM_SOURCE.inverse(), looks()).passed


@pytest.mark.parametrize("wrong", [shifted(0.0, 0.0, 15.0), shifted(0.0, 0.0, -15.0)], ids=["above", "below"])
def test_depths_that_disagree_refuse_it(state: MapState, wrong: Sim3) -> None:
    verdict = check_overlap(state.part(1), state.part(0), wrong, looks())
    assert not verdict.passed and "depths disagree" in verdict.reason
    assert verdict.numbers["agreeing_frames"] < 0.5


def test_a_wrong_scale_is_refused(state: MapState) -> None:
    """Unless it keeps flat ground where it is, which depths cannot tell; overlapping points decide that before."""
    middle = world_from_cam(17).translation
    grown = Sim3(1.3, np.eye(3), -0.3 * middle) @ INTO_FROM_SOURCE
    verdict = check_overlap(state.part(1), state.part(0), grown, looks())
    assert not verdict.passed and "depths disagree" in verdict.reason


def test_look_alikes_are_refused(state: MapState) -> None:
    """The ground is flat enough for the depths to agree anywhere; the pictures are of another place."""
    verdict = check_overlap(state.part(1), state.part(0), INTO_FROM_SOURCE, looks(elsewhere=ROWS[1]))
    assert not verdict.passed and "does not look alike" in verdict.reason
    assert verdict.numbers["unlike_frames"] == 1.0


@pytest.mark.parametrize(("low", "spread"), [(0.9, 0.1), (0.0, 0.2)])
def test_the_border_follows_what_neighbours_look_like(state: MapState, low: float, spread: float) -> None:
    """A descriptor by which all pictures are much alike, or little, decides the same."""

    def squeezed(
        similar: Callable[[Sequence[int], Sequence[int]], np.ndarray],
    ) -> Callable[[Sequence[int], Sequence[int]], np.ndarray]:
        return lambda first, second: low + spread * similar(first, second)

    assert check_overlap(state.part(1), state.part(0), INTO_FROM_SOURCE, squeezed(looks())).passed
    elsewhere = squeezed(looks(elsewhere=ROWS[1]))
    assert not check_overlap(state.part(1), state.part(0), INTO_FROM_SOURCE, elsewhere).passed


def test_parts_that_would_not_overlap_are_not_joined(state: MapState) -> None:
    verdict = check_overlap(state.part(1), state.part(0), shifted(3000.0, 0.0, 0.0), looks())
    assert verdict.reason == "they would not overlap"


def test_frames_without_points_say_nothing(state: MapState, monkeypatch: pytest.MonkeyPatch) -> None:
    known = MapState.reference

    def few(self: MapState, index: int) -> object:
        reference = known(self, index)
        empty = index % 2 == 0
        return replace(reference, points=reference.points[:0], pixels=reference.pixels[:0]) if empty else reference

    monkeypatch.setattr(MapState, "reference", few)
    verdict = check_overlap(state.part(1), state.part(0), INTO_FROM_SOURCE, looks())
    assert verdict.passed and verdict.numbers["overlapping_frames"] <= 8
