"""Which frames of two fragments are reconstructed together."""

from __future__ import annotations

import numpy as np

from onthefly3r.selection.bridge import FRAMES_OF_EACH, bridging_subset, near_pairs
from onthefly3r.selection.frontier import NEAREST, Frontier
from onthefly3r.selection.index import RetrievalIndex

STEP_DEG = 3.0


def on_a_line(count: int, places: dict[int, np.ndarray] | None = None) -> tuple[RetrievalIndex, Frontier]:
    """Images on a great circle, each most like the next ones on both sides."""
    index, frontier = RetrievalIndex(), Frontier()
    for k in range(count):
        angle = np.radians(STEP_DEG * k)
        index.add(k, np.array([np.cos(angle), np.sin(angle), 0.0], np.float32), (places or {}).get(k))
    frontier.add(list(range(count)), index)
    return index, frontier


def test_pairs_across_are_near_neighbours_most_alike_first() -> None:
    index, frontier = on_a_line(60)
    first, second = list(range(30)), list(range(30, 60))
    pairs = near_pairs(first, second, index, frontier, use_positions=False)
    assert pairs[0] == (29, 30) and all(a in first and b in second for a, b in pairs)
    away = [b - a for a, b in pairs]
    assert away == sorted(away) and max(away) == NEAREST // 2  # six of its twelve neighbours are on either side


def test_fragments_far_from_each_other_have_no_pairs() -> None:
    index, frontier = on_a_line(60)
    assert near_pairs(list(range(20)), list(range(40, 60)), index, frontier, use_positions=False) == []


def test_positions_propose_the_nearest_across_where_they_may() -> None:
    places = {k: np.array([float(k), 0.0]) for k in range(60)} | {5: np.array([44.5, 0.0])}
    index, frontier = on_a_line(60, places)
    apart = (list(range(20)), list(range(40, 60)))
    pairs = near_pairs(*apart, index, frontier, use_positions=True)
    assert {a for a, b in pairs if b == 44} == {5} and (19, 40) in pairs


def test_a_bridging_subset_has_the_pair_and_what_is_most_like_it_of_each() -> None:
    index, _ = on_a_line(60)
    subset = bridging_subset((29, 30), list(range(30)), list(range(30, 60)), index, effort=1)
    assert subset.new == () and subset.effort == 1
    assert subset.references[0] == 29 and subset.references[FRAMES_OF_EACH] == 30
    assert set(subset.references) == set(range(30 - FRAMES_OF_EACH, 30 + FRAMES_OF_EACH))


def test_a_small_fragment_gives_what_it_has() -> None:
    index, _ = on_a_line(20)
    subset = bridging_subset((9, 10), list(range(10)), [10, 11], index, effort=0)
    assert subset.references[-2:] == (10, 11) and len(subset.references) == FRAMES_OF_EACH + 2
