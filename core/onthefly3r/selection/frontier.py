"""Which images may join a subset: those whose nearest neighbours are in it.

Retrieval always finds k frames, however far away. An image that is reconstructed together with frames that do not see
its ground may be put anywhere, and on even ground nothing betrays it. So an image waits until some of
its near neighbours among all images are in the subset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..records import Subset
from .index import RetrievalIndex

NEAREST = 12  # so many images seen so far are an image's near neighbours: ranks mean the same for any descriptor
NEIGHBOURS = 3  # of them must be in the subset: fewer references are not enough to register an image
BLOCK = 1000  # rows of similarities at a time
MOST_LOOKED_AT = 2000  # waiting images among which a group is looked for
ROUNDING = 1e-6


class Frontier:
    """The highest similarities of every described image to all others."""

    def __init__(self) -> None:
        self._row_of: dict[int, int] = {}
        self._to_all: Float = np.zeros((0, NEAREST), np.float32)  # in no order

    def add(self, new: Sequence[int], retrieval: RetrievalIndex) -> None:
        """Take described images; `retrieval` knows them already."""
        before = list(self._row_of)
        self._row_of.update({index: len(before) + k for k, index in enumerate(new)})
        empty = np.zeros((len(new), NEAREST), np.float32)
        self._to_all = np.vstack([self._to_all, empty])
        known = list(self._row_of)
        for start in range(0, len(new), BLOCK):
            block = new[start : start + BLOCK]
            similarity = np.array(retrieval.similarities(block, known))
            rows = [self._row_of[index] for index in block]
            similarity[np.arange(len(block)), rows] = 0.0  # nothing is its own neighbour
            self._to_all[rows] = _highest(similarity, NEAREST)
            if before:
                self._to_all[: len(before)] = _merged(self._to_all[: len(before)], similarity[:, : len(before)].T)

    def support(
        self, images: Sequence[int], references: Sequence[int], retrieval: RetrievalIndex
    ) -> Callable[[Sequence[int], Sequence[int]], bool]:
        """Return the test whether a batch hangs together with its references.

        In the batch's order, the near neighbours of each image must be among the references and the images before it:
        so the first one hangs on the map alone, and the others need not all see what the references see.
        """
        to_references = retrieval.similarities(images, references)
        to_images = retrieval.similarities(images, images)
        row = {index: i for i, index in enumerate(images)}
        column = {index: i for i, index in enumerate(references)}
        least = self._to_all[[self._row_of[index] for index in images]].min(axis=1)

        def supported(batch: Sequence[int], kept: Sequence[int]) -> bool:
            rows, columns = [row[index] for index in batch], [column[index] for index in kept]
            joined = np.hstack([to_references[np.ix_(rows, columns)], np.tril(to_images[np.ix_(rows, rows)], -1)])
            return bool((_highest(joined, NEIGHBOURS).min(axis=1) >= least[rows]).all())

        return supported

    def least(self, images: Sequence[int]) -> Float:
        """Return the similarity (N,) from which on another image is among the near neighbours of each."""
        return np.asarray(self._to_all[[self._row_of[index] for index in images]].min(axis=1))

    def hanging_together(
        self, images: Sequence[int], retrieval: RetrievalIndex, first: Sequence[int] = ()
    ) -> list[int]:
        """Return those images that have enough near neighbours among each other, as far as links connect them.

        The largest such group, or that of the first one of `first`, in the order given.
        """
        kept = list(images)[:MOST_LOOKED_AT]
        while True:
            near = self._near(kept, kept, retrieval)
            enough = near.sum(axis=1) >= NEIGHBOURS
            if enough.all():
                break
            kept = [index for index, is_held in zip(kept, enough, strict=True) if is_held]
        if not kept or (first and first[0] not in kept):
            return []
        group = _connected(near | near.T)
        wanted = group[kept.index(first[0])] if first else np.bincount(group).argmax()
        return [index for index, label in zip(kept, group, strict=True) if label == wanted]

    def prefers(self, images: Sequence[int], others: Iterable[int], retrieval: RetrievalIndex) -> bool:
        """Return whether images have at least as many near neighbours among others as among each other."""
        among_others = self._near(images, list(others), retrieval).sum()
        return bool(among_others >= self._near(images, images, retrieval).sum())

    def _near(self, images: Sequence[int], others: Sequence[int], retrieval: RetrievalIndex) -> Bool:
        """Return which others (N, M) are among the near neighbours of each image; nothing is its own."""
        if not images or not others:
            return np.zeros((len(images), len(others)), bool)
        similarity = retrieval.similarities(images, others)
        # What rounding takes off a similarity that was computed in another block must not matter.
        near = similarity >= self.least(images)[:, None] - ROUNDING
        return np.asarray(near & (np.array(images)[:, None] != np.array(others)[None, :]))


def _connected(linked: Bool) -> Int:
    """Return the number of the group of each image (N,), by a symmetric table of links (N, N)."""
    from scipy.sparse.csgraph import connected_components

    return np.asarray(connected_components(linked, directed=False)[1])


def orphans(subset: Subset, kept: Sequence[int], retrieval: RetrievalIndex, min_shared: int) -> list[int]:
    """Return the new images that fewer than `min_shared` of their own most similar references speak for.

    The references that validation kept may all lie elsewhere: then the new image went with the others.
    """
    similarity = retrieval.similarities(subset.new, subset.references)
    own = np.argsort(-similarity, axis=1, kind="stable")[:, :NEIGHBOURS]
    shared = np.isin(np.array(subset.references)[own], kept).sum(axis=1)
    enough = min(min_shared, len(subset.references))
    return [index for index, count in zip(subset.new, shared, strict=True) if count < enough]


def _merged(kept: Float, offered: Float) -> Float:
    return _highest(np.hstack([kept, offered]), NEAREST)


def _highest(similarity: Float, count: int) -> Float:
    """Return the highest similarities (N, count) of each row (N, M), zero where there are too few."""
    padded = np.hstack([similarity, np.zeros((len(similarity), count), np.float32)])
    return np.asarray(np.partition(padded, -count, axis=1)[:, -count:], np.float32)
