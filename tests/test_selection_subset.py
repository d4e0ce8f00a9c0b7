from __future__ import annotations

from collections.abc import Sequence

import pytest

from onthefly3r.options import SelectionOptions
from onthefly3r.records import Neighbour, Subset
from onthefly3r.selection.subset import build_subset, dominant_references, fixed_subset

STRICT = SelectionOptions(lookahead=1, subset_references=5)
FREE = SelectionOptions(subset_references=5)


def on_a_line(*queries: int, k: int = 5) -> dict[int, list[Neighbour]]:
    """Images 100, 101, ... above a line of frames 0, 1, ...: image 100 + i is most like frame i."""
    found = {}
    for query in queries:
        frames = sorted(range(60), key=lambda r: (abs(r - (query - 100)), r))[:k]
        found[query] = [Neighbour(r, 1.0 - 0.1 * abs(r - (query - 100))) for r in frames]
    return found


def closeness(a: int, b: int) -> float:
    return 1.0 - 0.05 * abs(a - b)


def build(waiting: Sequence[int], options: SelectionOptions) -> Subset:
    return build_subset(waiting, on_a_line(*waiting), closeness, options)


def test_dominant_references_are_ranked_by_votes_then_by_similarity() -> None:
    neighbours = {
        1: [Neighbour(7, 0.9), Neighbour(8, 0.5)],
        2: [Neighbour(8, 0.5), Neighbour(9, 0.8)],
        3: [Neighbour(6, 0.7)],
    }
    assert dominant_references([1, 2, 3], neighbours, 5) == (8, 7, 9, 6)
    assert dominant_references([1, 2, 3], neighbours, 2) == (8, 7)


def test_in_strict_order_the_batch_stops_at_the_first_misfit() -> None:
    assert build([110, 111, 112, 140, 113], STRICT).new == (110, 111, 112)
    assert build([140, 110, 111], STRICT).new == (140,)
    assert build([110, 111, 112, 113, 114, 115], STRICT).new == (110, 111, 112, 113, 114)


def test_references_are_those_that_the_batch_shares() -> None:
    assert set(build([110, 111, 112], STRICT).references) == {9, 10, 11, 12, 13}


def test_a_look_ahead_fills_the_batch_from_shuffled_input() -> None:
    shuffled = [110, 140, 111, 125, 141, 112, 126, 142, 113, 127, 143, 114, 128]
    batch = build(shuffled, FREE).new
    assert len(batch) == 5
    assert max(batch) - min(batch) <= 6
    assert len(build(shuffled, STRICT).new) == 1


@pytest.mark.parametrize("options", [STRICT, FREE])
def test_both_thresholds_count(options: SelectionOptions) -> None:
    """Eq. 7: shared references AND similarity to the batch."""
    from dataclasses import replace

    waiting = [110, 111, 112]
    assert len(build(waiting, replace(options, min_similarity=0.94)).new) == 3
    assert len(build(waiting, replace(options, min_similarity=0.96)).new) == 1
    assert len(build(waiting, replace(options, min_shared_references=6)).new) == 1


def test_a_full_batch_is_preferred_among_starts() -> None:
    """Image 159 hangs best on the map but has no companions."""
    neighbours = on_a_line(*range(110, 115), 159)
    neighbours[159] = [Neighbour(r, 2.0) for r in (55, 56, 57, 58, 59)]
    assert set(build_subset([159, *range(110, 115)], neighbours, closeness, FREE).new) == set(range(110, 115))


def test_images_whose_support_would_leave_the_subset_stay_out() -> None:
    waiting = list(range(110, 115))

    def supported(images: Sequence[int], references: Sequence[int]) -> bool:
        return 112 not in images

    batch = build_subset(waiting, on_a_line(*waiting), closeness, FREE, supported).new
    assert set(batch) == {110, 111, 113, 114}
    nothing = build_subset(waiting, on_a_line(*waiting), closeness, FREE, lambda images, references: False)
    assert len(nothing.new) == 1  # one must go on


def test_fixed_batches_take_images_as_they_come_with_the_last_frames() -> None:
    options = SelectionOptions(batching="fixed", batch_size=3, subset_references=4)
    assert fixed_subset([9, 2, 7, 5], [1, 3, 8, 4, 6], options) == Subset((3, 8, 4, 6), (9, 2, 7))
