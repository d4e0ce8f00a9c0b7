"""Fragments of a map: each is a map of its own until it is joined, and a join can be undone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from test_map_state import assert_same, batch, filled, pose, sighting


def in_two(work: Path) -> MapState:
    """Submaps 0 and 1 of frames 4, 2, 9, 7, 1; apart from them submaps 2 and 3 of frames 5 and 6."""
    state = filled(work)
    state.set_spacing(0.5, 2)
    submap, frames = batch(2, [5])
    state.commit(replace(submap, fragment=2), frames)
    submap, frames = batch(3, [6], (sighting(5, 3), sighting(7, 3)))
    state.commit(replace(submap, fragment=2), frames)
    return state


def test_a_part_shows_one_fragment_only(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    assert state.fragments() == {0: [4, 2, 9, 7, 1], 2: [5, 6]}
    small, large = state.part(2), state.part(0)
    assert list(small.frames) == [5, 6] and set(small.map_from_submap) == {2, 3}
    assert [(s.frame, s.submap) for s in small.sightings] == [(5, 3)]  # frame 7 lies in the other fragment
    assert (small.spacing, large.spacing, state.spacing) == (0.5, 0.0123, 0.0123)
    np.testing.assert_array_equal(small.map_from_cam(6).matrix(), state.map_from_cam(6).matrix())
    assert small.next_submap() == state.next_submap() == 4


def test_what_is_moved_in_a_part_moves_in_the_map(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    state.part(2).move_submaps({3: pose(9)}, {5: pose(10)}, {})
    for map_ in (state, MapState.load(Store(tmp_path))):
        np.testing.assert_array_equal(map_.map_from_submap[3].matrix(), pose(9).matrix())
        np.testing.assert_array_equal(map_.submap_pose_of(5).matrix(), pose(10).matrix())


def test_a_part_takes_no_batches(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="commit to the map itself"):
        in_two(tmp_path).part(2).commit(*batch(4, [8]))


def test_a_join_moves_one_fragment_as_a_whole_and_lets_sightings_count(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    state.part(2).move_submaps({}, {5: pose(10)}, {})
    before = {i: state.map_from_cam(i) for i in state.frames}
    state.join(2, 0, pose(20))
    again = MapState.load(Store(tmp_path))
    assert_same(state, again)
    for map_ in (state, again):
        assert list(map_.fragments()) == [0] and map_.part(0) is map_
        for index in (5, 6):
            moved = pose(20).apply_to_pose(before[index])
            np.testing.assert_allclose(map_.map_from_cam(index).matrix(), moved.matrix(), atol=1e-12)
        np.testing.assert_array_equal(map_.map_from_cam(4).matrix(), before[4].matrix())
        assert (7, 3) in [(s.frame, s.submap) for s in map_.part(0).sightings]


def test_a_join_is_undone_with_all_that_came_of_it(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    state.join(2, 0, pose(20))
    state.part_with([2, 3], 2)
    again = MapState.load(Store(tmp_path))
    assert_same(state, again)
    for map_ in (state, again):
        assert map_.fragments() == {0: [4, 2, 9, 7, 1], 2: [5, 6]}
        assert (7, 3) not in [(s.frame, s.submap) for s in map_.sightings]  # the wrong tie does not come back
        assert map_.part(2).spacing == pytest.approx(0.0123)  # it stays in the units that it was brought to


def test_what_is_shown_elsewhere_stays_where_it_is_in_the_journal(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    before = state.map_from_cam(6)
    state.shift(2, pose(20))
    np.testing.assert_allclose(state.map_from_cam(6).matrix(), pose(20).apply_to_pose(before).matrix(), atol=1e-12)
    np.testing.assert_array_equal(MapState.load(Store(tmp_path)).map_from_cam(6).matrix(), before.matrix())


def test_a_submap_without_frames_ties_two_fragments(tmp_path: Path) -> None:
    state = in_two(tmp_path)
    submap, _ = batch(4, [], (sighting(6, 4), sighting(7, 4)))
    state.commit(submap, [])
    state.join(2, 0, pose(20))
    again = MapState.load(Store(tmp_path))
    assert_same(state, again)
    assert again.next_submap() == 5
