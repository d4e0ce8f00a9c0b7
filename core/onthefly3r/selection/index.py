"""An exact, growing table of descriptors: cosine similarities (Eq. 4) and top-k retrieval (Eq. 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.arrays import Float
from ..records import Neighbour


class RetrievalIndex:
    """Descriptors by shot index; exact search by matrix product."""

    def __init__(self) -> None:
        self._rows: dict[int, int] = {}
        self._table: Float = np.zeros((0, 0), np.float32)

    def __contains__(self, index: int) -> bool:
        return index in self._rows

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, index: int, descriptor: Float) -> None:
        """Add one L2-normalised descriptor (D,); the table doubles when it is full."""
        row = len(self._rows)
        if row == len(self._table):
            grown = np.zeros((max(64, 2 * row), len(descriptor)), np.float32)
            if row:
                grown[:row] = self._table
            self._table = grown
        self._table[row] = descriptor
        self._rows[index] = row

    def similarities(self, first: Sequence[int], second: Sequence[int]) -> Float:
        """Return s(q, r) = d_q . d_r (Eq. 4) for all pairs: (len(first), len(second))."""
        rows = [self._rows[i] for i in first]
        columns = [self._rows[i] for i in second]
        return np.asarray(self._table[rows] @ self._table[columns].T)

    def top(self, queries: Sequence[int], among: Sequence[int], k: int) -> dict[int, list[Neighbour]]:
        """Return N_k(q), the k most similar frames of `among` for each query (Eq. 5), best first."""
        if not among or not queries:
            return {q: [] for q in queries}
        similarity = self.similarities(queries, among)
        found = {}
        for row, query in zip(similarity, queries, strict=True):
            best = np.argsort(-row, kind="stable")[: k + 1]
            found[query] = [Neighbour(among[i], float(row[i])) for i in best if among[i] != query][:k]
        return found
