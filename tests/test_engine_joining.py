"""Joins that later subsets contradict are undone, with all that came of them; those that are confirmed stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fragments
from onthefly3r.engine.joining import Joins
from onthefly3r.geometry.transforms import Sim3
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.options import Options
from test_map_fragments import in_two
from test_map_state import assert_same, batch, pose, sighting

INTO_FROM_SOURCE = pose(20)
INTO, SOURCE = [4, 2, 9, 7, 1], [5, 6]


class Calls:
    """What a part of the engine was asked to do."""

    def __init__(self) -> None:
        self.made: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self.made.append((name, *given))


def told(map_from_local: Sim3) -> Any:
    """A registration, as far as a join asks."""
    return SimpleNamespace(alignment=SimpleNamespace(map_from_local=map_from_local))


def in_fragment(fragment: int, number: int, frames: list[int]) -> Any:
    submap, new = batch(number, frames)
    return replace(submap, fragment=fragment), new


@pytest.fixture
def joined(tmp_path: Path) -> tuple[Joins, MapState, Calls]:
    """Fragment 2 joined with 0 by submap 4; since then 5 hangs on what was fragment 2, and 6 mostly on what was 0."""
    state, drift = in_two(tmp_path), Calls()
    state.commit(batch(4, [], (sighting(6, 4), sighting(7, 4)))[0], [])
    bench = SimpleNamespace(state=state, retry=Calls(), options=Options())
    joins = Joins(bench, drift, lambda *_: None)  # type: ignore[arg-type]
    joins.make(2, 0, told(INTO_FROM_SOURCE), told(Sim3()), 4)
    state.commit(*batch(5, [8], (sighting(5, 5), sighting(6, 5), sighting(4, 5))))
    state.commit(*batch(6, [10], (sighting(4, 6), sighting(9, 6), sighting(8, 6))))
    state.commit(*in_fragment(7, 7, [20, 21]))  # a third one, which nothing ties
    assert state.fragments() == {0: [*INTO, *SOURCE, 8, 10], 7: [20, 21]} and bench.retry.made == [("reopen",)]
    return joins, state, drift


def test_the_smaller_fragment_moves_whichever_is_named_first(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    bench = SimpleNamespace(state=state, retry=Calls(), options=Options())
    before = {i: state.map_from_cam(i) for i in state.frames}
    joins = Joins(bench, Calls(), lambda *_: None)  # type: ignore[arg-type]
    joins.make(0, 2, told(INTO_FROM_SOURCE.inverse()), told(Sim3()), 4)  # from the larger one into the smaller
    assert list(state.fragments()) == [0]
    for index in (*INTO, *SOURCE):
        expected = INTO_FROM_SOURCE.apply_to_pose(before[index]) if index in SOURCE else before[index]
        np.testing.assert_allclose(state.map_from_cam(index).matrix(), expected.matrix(), atol=1e-9)


def test_two_contradictions_undo_a_join_with_what_came_of_it(
    joined: tuple[Joins, MapState, Calls], tmp_path: Path
) -> None:
    joins, state, drift = joined
    places = {i: state.map_from_cam(i) for i in state.frames}
    drift.made.clear()
    joins.heard(0, [4, 2, 5, 6], [4, 2])
    assert len(state.fragments()) == 2 and not drift.made
    joins.heard(0, [9, 7, 6, 8], [6, 8])  # the other side may be the one that is kept
    again = MapState.load(Store(tmp_path))
    assert_same(state, again)
    for map_ in (state, again):
        assert map_.fragments() == {0: [*INTO, 10], 2: [*SOURCE, 8], 7: [20, 21]}
        ties = [(seen.frame, seen.submap) for seen in map_.sightings]
        assert not {(7, 3), (6, 4), (4, 5), (8, 6)} & set(ties)  # none goes from one to the other
        assert {(5, 3), (7, 4), (5, 5), (6, 5), (4, 6), (9, 6)} <= set(ties)
        for index, at in places.items():
            np.testing.assert_array_equal(map_.map_from_cam(index).matrix(), at.matrix())
    assert drift.made == [("forget", 0), ("optimise", 0), ("optimise", 2)]
    assert (joins.memory.undone, joins.memory.joined) == (1, [])
    again.commit(*batch(8, [11], (sighting(5, 8),)))  # and the journal goes on
    assert_same(MapState.load(Store(tmp_path)), again)


def test_confirmations_weigh_against_contradictions(joined: tuple[Joins, MapState, Calls]) -> None:
    joins, state, _ = joined
    joins.heard(0, [4, 2, 5, 6], [4, 5, 6])
    for _ in range(2):
        joins.heard(0, [4, 2, 5, 6], [5, 6])
    assert len(state.fragments()) == 2
    joins.heard(0, [4, 2, 5, 6], [5, 6])
    assert len(state.fragments()) == 3


def test_a_subset_says_nothing_of_a_join_that_it_does_not_span(joined: tuple[Joins, MapState, Calls]) -> None:
    joins, state, _ = joined
    for _ in range(5):
        joins.heard(0, [4, 2, 9, 5], [4, 2, 9])  # one frame may be wrong for reasons of its own
        joins.heard(0, [4, 2, 9, 7], [])
        joins.heard(7, [4, 2, 5, 6], [20, 21])
        joins.heard(0, [5, 6, 20, 21], [5, 6])  # the others lie in another fragment
        joins.heard(0, [5, 6, 8, 9], [5, 6, 8])  # 8 came later, on the side of 5 and 6
    assert len(state.fragments()) == 2
    assert (joins.memory.joined[0].confirmations, joins.memory.joined[0].contradictions) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(200, 205))
def test_look_alike_halves_stay_apart(tmp_path: Path, seed: int) -> None:
    row = fragments.measure("look-alike", False, seed, tmp_path)
    assert len(row.parts) >= 2 and row.misplaced == 0, row  # a join within a half is right
    assert row.placed >= 0.98 * row.images, row


@pytest.mark.slow
@pytest.mark.parametrize("positions", [True, False])
def test_three_drones_that_meet_are_one_map(tmp_path: Path, positions: bool) -> None:
    row = fragments.measure("drones", positions, 200, tmp_path)
    assert len(row.parts) == 1 and row.joins >= 2 and row.misplaced == 0, row
    assert row.placed == row.images, row
