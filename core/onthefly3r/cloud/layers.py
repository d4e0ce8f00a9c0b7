"""How far the sheets of single photographs lie apart: the internal consistency of a cloud.

Over a grid of small cells, the range of the photographs' median heights in a cell, after the slope of the cell is taken
out. A clean cloud has a range of a fraction of the ground sampling distance; a stack of sheets has several.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float, Int
from .views import View

CELL_M = 1.0
CELL_GSD = 12.0  # of a frame whose unit is not the metre
MOST_CELLS = 1000  # about as many are looked at
LEAST_POINTS, LEAST_PER_PHOTOGRAPH = 30, 8  # in a cell
TYPICAL_OVERLAP = 6.0  # photographs that see a place
WANTED_PER_PHOTOGRAPH = 50  # points of a photograph in a cell: no more than about so many take part


@dataclass(frozen=True)
class LayerSpread:
    """Range of the photographs' median heights per cell, in the unit of the points; NaN without cells."""

    cell: float
    cells: int
    median: float
    p90: float


class LayerCollector:
    """Gathers the points of single photographs in a sample of cells."""

    def __init__(self, cell: float, area: float, stride: int = 1) -> None:
        """`cell`: its side; `area`: about how much ground there is, in square units; `stride`: of points that count."""
        self._cell, self._stride = cell, stride
        self._every = max(1, int(area / cell**2 / MOST_CELLS)) if np.isfinite(area) else 1
        self._parts: list[tuple[Int, Float, Int]] = []

    @classmethod
    def over(cls, views: Mapping[int, View], metric: bool) -> LayerCollector:
        """Return a collector for what photographs see."""
        gsd = float(np.nanmedian([view.gsd for view in views.values()])) if views else float("nan")
        pixels = float(np.median([view.grid.width * view.grid.height for view in views.values()])) if views else 0.0
        cell = CELL_M if metric else CELL_GSD * gsd
        stride = max(1, int((cell / gsd) ** 2 / WANTED_PER_PHOTOGRAPH)) if gsd > 0.0 else 1
        return cls(cell, len(views) / TYPICAL_OVERLAP * pixels * gsd**2, stride)

    def add(self, source: int, points: Float) -> None:
        """Add points (N, 3) of one photograph."""
        points = points[:: self._stride]
        column, row = np.floor(points[:, :2] / self._cell).astype(np.int64).T
        chosen = (column * 73_856_093 ^ row * 19_349_663) % self._every == 0  # scattered, the same in every run
        key = (row[chosen] << 32) + (column[chosen] & 0xFFFFFFFF)
        self._parts.append((key, points[chosen], np.full(len(key), source)))

    def spread(self) -> LayerSpread:
        """Return the figures of what was gathered."""
        if not self._parts:
            return LayerSpread(self._cell, 0, float("nan"), float("nan"))
        key, points, source = (np.concatenate(column) for column in zip(*self._parts, strict=True))
        order = np.lexsort((source, key))
        key, points, source = key[order], points[order], source[order]
        starts = np.flatnonzero(np.diff(key, prepend=key[:1] - 1))
        ranges = [
            found
            for first, last in zip(starts, np.append(starts[1:], len(key)), strict=True)
            if last - first >= LEAST_POINTS
            and (found := cell_range(points[first:last], source[first:last])) is not None
        ]
        if not ranges:
            return LayerSpread(self._cell, 0, float("nan"), float("nan"))
        return LayerSpread(self._cell, len(ranges), float(np.median(ranges)), float(np.percentile(ranges, 90)))


def cell_range(points: Float, source: Int) -> float | None:
    """Return the range of the photographs' median heights in one cell, None where fewer than two see it well.

    points: (N, 3); source: (N,) ascending, the photograph of each.
    """
    offset = points - points.mean(axis=0)
    plane = np.column_stack([offset[:, :2], np.ones(len(offset))])
    height = offset[:, 2] - plane @ np.linalg.lstsq(plane, offset[:, 2], rcond=None)[0]
    starts = np.flatnonzero(np.diff(source, prepend=source[0] - 1))
    parts = [part for part in np.split(height, starts[1:]) if len(part) >= LEAST_PER_PHOTOGRAPH]
    if len(parts) < 2:
        return None
    medians = [float(np.median(part)) for part in parts]
    return max(medians) - min(medians)
