"""Which images may be reconstructed with the map, and which wait for their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.records import Subset
from onthefly3r.selection.frontier import Frontier, orphans
from onthefly3r.selection.index import RetrievalIndex

ANGLE_DEG = 3.0  # between neighbours on a line; the twelve nearest are six on each side


def line(count: int, index: RetrievalIndex | None = None) -> RetrievalIndex:
    """Images on a great circle: the further apart, the less alike."""
    index = index or RetrievalIndex()
    for k in range(count):
        angle = np.radians(ANGLE_DEG * k)
        index.add(k, np.array([np.cos(angle), np.sin(angle), 0.0], np.float32))
    return index


def frontier_of(index: RetrievalIndex, count: int) -> Frontier:
    frontier = Frontier()
    frontier.add(list(range(count)), index)
    return frontier


def test_images_next_to_the_references_are_supported_and_far_ones_are_not() -> None:
    index = line(30)
    supported = frontier_of(index, 30).support(range(4, 12), [0, 1, 2, 3], index)
    assert [image for image in range(4, 12) if supported([image], [0, 1, 2, 3])] == [4, 5, 6, 7]
    assert not supported([4], [0, 1])


def test_images_hang_on_those_before_them_in_the_batch() -> None:
    index = line(30)
    supported = frontier_of(index, 30).support(range(4, 12), [0, 1, 2, 3], index)
    assert supported([4, 5, 6, 7, 8, 9], [0, 1, 2, 3])
    assert not supported([8, 7, 6, 5], [0, 1, 2, 3])  # the first hangs on the references alone
    assert not supported([4, 9], [0, 1, 2, 3])


@pytest.mark.parametrize("step", [1, 7, 30])
def test_images_that_arrive_one_by_one_are_judged_like_all_at_once(step: int) -> None:
    index = line(30)
    frontier = Frontier()
    for start in range(0, 30, step):
        frontier.add(list(range(start, min(start + step, 30))), index)
    supported = frontier.support(range(4, 12), [0, 1, 2, 3], index)
    assert [image for image in range(4, 12) if supported([image], [0, 1, 2, 3])] == [4, 5, 6, 7]


def test_a_far_image_is_supported_where_nothing_is_nearer() -> None:
    index = line(4)
    angle = np.radians(ANGLE_DEG * 7)
    index.add(4, np.array([np.cos(angle), np.sin(angle), 0.0], np.float32))
    assert frontier_of(index, 5).support([4], [0, 1, 2, 3], index)([4], [0, 1, 2, 3])


def test_orphans_are_images_whose_own_references_were_pruned() -> None:
    index = line(12)
    subset = Subset((0, 1, 2, 9, 10, 11), (3, 8))
    assert orphans(subset, (0, 1, 2), index, min_shared=2) == [8]
    assert orphans(subset, (9, 10, 11), index, min_shared=2) == [3]
    assert orphans(subset, (0, 1, 2, 9, 10), index, min_shared=2) == []
    assert orphans(Subset((0,), (3,)), (0,), index, min_shared=2) == []
