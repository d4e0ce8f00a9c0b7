"""An exact, growing table of descriptors and rough positions: similarities (Eq. 4) and top-k retrieval (Eq. 5)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..records import Neighbour

# Descriptors are kept in multiples of 1/STEPS, cut towards zero: each product is then a multiple of 1/STEPS^2, no
# partial sum is above 1, and all of them are exact in float32. A similarity is the same in whatever block, order or
# thread it is computed, so that a run that goes on from its folder decides as one that was never stopped.
STEPS = 4096
KEPT_ROWS = 256  # similarity rows of images that wait: about 24 KB each at 6,000 images


class RetrievalIndex:
    """Descriptors by shot index, and which of them are in the map; exact search by matrix product.

    What one image is like is computed once against every other image and kept while it waits, so that a step costs
    no matrix product over the whole table again.
    """

    def __init__(self) -> None:
        self._row_of: dict[int, int] = {}
        self._index_of: Int = np.zeros(0, int)
        self._table: Float = np.zeros((0, 0), np.float32)
        self._positions: Float = np.zeros((0, 2))  # m, NaN where unknown
        self._accepted: Bool = np.zeros(0, bool)
        self._tie: Float = np.zeros(0, np.float32)  # similarity to the most similar frame of the map
        self._similar: OrderedDict[int, Float] = OrderedDict()

    def __contains__(self, index: int) -> bool:
        return index in self._row_of

    def __len__(self) -> int:
        return len(self._row_of)

    def add(self, index: int, descriptor: Float, position: Float | None = None) -> None:
        """Add one L2-normalised descriptor (D,) and, where there is one, a rough position (2,) in metres."""
        row = len(self._row_of)
        if row == len(self._table):
            self._grow(max(64, row + row // 2), len(descriptor))
        self._table[row] = np.trunc(np.asarray(descriptor) * STEPS) / STEPS
        self._index_of[row] = index
        self._positions[row] = np.nan if position is None else position
        self._row_of[index] = row
        if self._accepted.any():
            (similarity,) = self._similarity_rows([index])
            self._tie[row] = similarity[self._accepted[: row + 1]].max()

    def accept(self, indices: Sequence[int]) -> None:
        """Let images be retrieved from now on: they are in the map (A_k)."""
        rows = [self._row_of[index] for index in indices]
        if not rows:
            return
        tie = (self._table[: len(self)] @ self._table[rows].T).max(axis=1)
        self._tie[: len(self)] = tie if not self._accepted.any() else np.maximum(self._tie[: len(self)], tie)
        self._accepted[rows] = True
        for index in indices:
            self._similar.pop(index, None)

    def best_tied(self, waiting: Sequence[int], count: int) -> list[int]:
        """Return those waiting images that are most similar to some frame of the map, in the order given."""
        if len(waiting) <= count:
            return list(waiting)
        tie = self._tie[[self._row_of[i] for i in waiting]]
        return [waiting[i] for i in np.sort(_largest(tie, count))]

    def similarities(self, first: Sequence[int], second: Sequence[int]) -> Float:
        """Return s(q, r) = d_q . d_r (Eq. 4) for all pairs: (len(first), len(second))."""
        if len(first) > len(second):
            return np.asarray(self.similarities(second, first).T)
        rows, columns = ([self._row_of[i] for i in indices] for indices in (first, second))
        if 2 * len(columns) > len(self):  # the whole table needs no copy
            return np.asarray((self._table[rows] @ self._table[: len(self)].T)[:, columns])
        return np.asarray(self._table[rows] @ self._table[columns].T)

    def top(self, queries: Sequence[int], k: int) -> dict[int, list[Neighbour]]:
        """Return N_k(q), the k most similar frames of the map for each query (Eq. 5), best first."""
        accepted = np.flatnonzero(self._accepted[: len(self)])
        found = {}
        for query, row in zip(queries, self._similarity_rows(queries), strict=True):
            candidates = accepted[accepted != self._row_of[query]]
            best = _largest(row[candidates], k)
            found[query] = [Neighbour(int(self._index_of[c]), float(row[c])) for c in candidates[best]]
        return found

    def nearest(self, query: int, k: int) -> list[Neighbour]:
        """Return the k frames of the map that are nearest by position, nearest first; none without a position."""
        row = self._row_of[query]
        accepted = np.flatnonzero(self._accepted[: len(self)])
        distance = np.linalg.norm(self._positions[accepted] - self._positions[row], axis=1)
        known = np.isfinite(distance) & (accepted != row)
        accepted, distance = accepted[known], distance[known]
        near = accepted[_largest(-distance, k)]
        if not len(near):
            return []
        similarity = self._table[near] @ self._table[row]
        return [Neighbour(int(self._index_of[n]), float(s)) for n, s in zip(near, similarity, strict=True)]

    def nearest_across(self, first: Sequence[int], second: Sequence[int]) -> Bool:
        """Return the pairs (N, M) of which one is the nearest by position to the other."""
        places = [self._positions[[self._row_of[i] for i in part]] for part in (first, second)]
        distance = np.linalg.norm(places[0][:, None] - places[1][None], axis=2)
        distance[~np.isfinite(distance)] = np.inf
        nearest = (distance == distance.min(axis=0)[None, :]) | (distance == distance.min(axis=1)[:, None])
        return np.asarray(nearest & np.isfinite(distance))

    def _similarity_rows(self, queries: Sequence[int]) -> list[Float]:
        """Return the similarities (N,) of each query to all images of the table."""
        count = len(self)
        new = [q for q in queries if q not in self._similar]
        if new:
            product = self._table[[self._row_of[q] for q in new]] @ self._table[:count].T
            self._similar.update({q: row.copy() for q, row in zip(new, product, strict=True)})
        rows = []
        for query in queries:
            row = self._similar[query]
            if len(row) < count:  # images have arrived since
                row = np.concatenate([row, self._table[len(row) : count] @ self._table[self._row_of[query]]])
                self._similar[query] = row
            self._similar.move_to_end(query)
            rows.append(row)
        while len(self._similar) > KEPT_ROWS:
            self._similar.popitem(last=False)
        return rows

    def _grow(self, capacity: int, length: int) -> None:
        more = capacity - len(self)
        self._table = np.vstack([self._table.reshape(-1, length), np.zeros((more, length), np.float32)])
        self._index_of = np.append(self._index_of, np.zeros(more, int))
        self._positions = np.vstack([self._positions, np.full((more, 2), np.nan)])
        self._accepted = np.append(self._accepted, np.zeros(more, bool))
        self._tie = np.append(self._tie, np.zeros(more, np.float32))


def _largest(values: Float, k: int) -> Int:
    """Return where the k largest values are, largest first; equal ones in their order."""
    if len(values) > 4 * k:  # sort only what can be among them
        threshold = np.partition(values, len(values) - k)[len(values) - k]
        candidates = np.flatnonzero(values >= threshold)
    else:
        candidates = np.arange(len(values))
    return np.asarray(candidates[np.argsort(-values[candidates], kind="stable")[:k]])
