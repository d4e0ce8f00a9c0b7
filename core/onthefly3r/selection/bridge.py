"""Which frames of two fragments to reconstruct together, to find out how the fragments lie to each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..records import Subset
from .frontier import Frontier
from .index import RetrievalIndex

FRAMES_OF_EACH = 6  # of each fragment in a bridging subset


def near_pairs(
    first: Sequence[int], second: Sequence[int], index: RetrievalIndex, frontier: Frontier, use_positions: bool
) -> list[tuple[int, int]]:
    """Return the pairs across two fragments that may see the same ground, most similar first.

    One of the two must be among the other's near neighbours of all images, or, where positions may propose, be its
    nearest frame of the other fragment.
    """
    similarity = index.similarities(first, second)
    near = (similarity >= frontier.least(first)[:, None]) | (similarity >= frontier.least(second)[None, :])
    if use_positions:
        near |= index.nearest_across(first, second)
    rows, columns = np.nonzero(near)
    order = np.argsort(-similarity[rows, columns], kind="stable")
    return [(first[rows[k]], second[columns[k]]) for k in order]


def bridging_subset(
    pair: tuple[int, int], first: Sequence[int], second: Sequence[int], index: RetrievalIndex, effort: int
) -> Subset:
    """Return the frames of both fragments that are most like a pair across them, as a subset without new images."""
    likeness = [index.similarities(members, pair).max(axis=1) for members in (first, second)]
    chosen: list[int] = []
    for own, members, alike in zip(pair, (first, second), likeness, strict=True):
        ranked = [members[k] for k in np.argsort(-alike, kind="stable") if members[k] != own]
        chosen += [own, *ranked[: FRAMES_OF_EACH - 1]]
    return Subset(references=tuple(chosen), new=(), effort=effort)
