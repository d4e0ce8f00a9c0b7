"""Which waiting images border on the map: those whose nearest neighbours are in it already.

Retrieval always finds k frames, however far away. An image that is reconstructed together with frames that do not see
its ground may be put anywhere, and on even ground nothing betrays it. So an image waits while images that are much
more similar to it than any frame of the map are still to be placed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.arrays import Float
from ..records import Subset
from .index import RetrievalIndex

NEIGHBOURS = 3  # similarities of so many are averaged: fewer references are not enough to register an image
READY = 0.8  # similarity to the map over similarity to everything seen, from which an image is ready
BLOCK = 1000  # rows of similarities at a time


class Frontier:
    """The highest similarities of every described image to all others, and to those in the map."""

    def __init__(self) -> None:
        self._row_of: dict[int, int] = {}
        self._to_all: Float = np.zeros((0, NEIGHBOURS), np.float32)  # in no order
        self._to_map: Float = np.zeros((0, NEIGHBOURS), np.float32)

    def add(self, new: Sequence[int], retrieval: RetrievalIndex) -> None:
        """Take described images; `retrieval` knows them already."""
        before = list(self._row_of)
        self._row_of.update({index: len(before) + k for k, index in enumerate(new)})
        empty = np.zeros((len(new), NEIGHBOURS), np.float32)
        self._to_all, self._to_map = np.vstack([self._to_all, empty]), np.vstack([self._to_map, empty])
        known = list(self._row_of)
        for start in range(0, len(new), BLOCK):
            block = new[start : start + BLOCK]
            similarity = np.array(retrieval.similarities(block, known))
            rows = [self._row_of[index] for index in block]
            similarity[np.arange(len(block)), rows] = 0.0  # nothing is its own neighbour
            self._to_all[rows] = _highest(similarity)
            if before:
                self._to_all[: len(before)] = _merged(self._to_all[: len(before)], similarity[:, : len(before)].T)

    def placed(self, new: Sequence[int], retrieval: RetrievalIndex) -> None:
        """Note that images are in the map now."""
        if new:
            self._to_map = _merged(self._to_map, retrieval.similarities(list(self._row_of), new))

    def ready(self, waiting: Sequence[int]) -> list[int]:
        """Return the waiting images that border on the map, in their order; the one nearest to it where none does."""
        if not waiting:
            return []
        return self._above(waiting, self._to_map[[self._row_of[index] for index in waiting]])

    def supported(self, subset: Subset, retrieval: RetrievalIndex) -> Subset:
        """Return a subset without the new images whose near neighbours its references are not, but never empty."""
        if not subset.references:
            return subset
        to_references = _highest(retrieval.similarities(subset.new, subset.references))
        return Subset(subset.references, tuple(self._above(subset.new, to_references)))

    def _above(self, images: Sequence[int], similar: Float) -> list[int]:
        """Return the images that are as similar to something, (N, NEIGHBOURS), as `READY` asks; the best if none is."""
        to_all = self._to_all[[self._row_of[index] for index in images]]
        share = similar.mean(axis=1) / np.maximum(to_all.mean(axis=1), 1e-6)
        above = [index for index, value in zip(images, share, strict=True) if value >= READY]
        return above or [images[int(np.argmax(share))]]


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
    return _highest(np.hstack([kept, offered]))


def _highest(similarity: Float) -> Float:
    """Return the highest similarities (N, NEIGHBOURS) of each row (N, M), zero where there are too few."""
    padded = np.hstack([similarity, np.zeros((len(similarity), NEIGHBOURS), np.float32)])
    return np.asarray(np.partition(padded, -NEIGHBOURS, axis=1)[:, -NEIGHBOURS:], np.float32)
