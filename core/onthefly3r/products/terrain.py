"""The ground below a cloud: a simple morphological filter over the lowest points (SMRF).

Pingel, Clarke and McBride, "An improved simple morphological filter for the terrain classification of airborne LIDAR
data", ISPRS Journal of Photogrammetry and Remote Sensing 77 (2013): sections in the comments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float
from .spool import Extent

MAX_CELLS = 16_000_000
MIN_CELL_M = 0.5
CELL_SPACINGS = 4.0
SLOPE = 0.2  # of the terrain, rise over run, beyond which a step is an object
MAX_OBJECT_M = 40.0  # widest house
LOW_SLOPE = 5.0  # of a single low blunder (section 2.2)
THRESHOLD_M = 0.25  # height above the ground up to which a point belongs to it,
THRESHOLD_SPACINGS = 2.0  # at least so many point spacings,
THRESHOLD_SLOPE = 0.6  # and this much more per rise over run of the ground


@dataclass(frozen=True)
class Terrain:
    """Ground heights on a grid; row 0 is the northern edge."""

    west: float
    north: float
    cell_m: float
    height_m: Float  # (H, W) float32, every cell filled
    slope: Float  # (H, W) float32 rise over run
    distance_m: Float  # (H, W) float32 to the nearest cell where ground was seen
    threshold_m: float

    def at(self, x: Float, y: Float) -> Float:
        """Return ground heights at positions of the same shape, bilinear."""
        return self._sample(self.height_m, x, y)

    def gap_m(self, x: Float, y: Float) -> Float:
        """Return how far from seen ground positions are."""
        return self._sample(self.distance_m, x, y)

    def is_ground(self, points: Float) -> Bool:
        """Return which points (N, 3) are ground (section 2.4)."""
        x, y, z = points.T
        allowed = self.threshold_m + THRESHOLD_SLOPE * self._sample(self.slope, x, y)
        return np.asarray(np.abs(z - self.at(x, y)) <= allowed)

    def _sample(self, grid: Float, x: Float, y: Float) -> Float:
        from scipy.ndimage import map_coordinates

        rows, columns = (self.north - y) / self.cell_m - 0.5, (x - self.west) / self.cell_m - 0.5
        return np.asarray(map_coordinates(grid, [rows, columns], order=1, mode="nearest"))


class LowestPoints:
    """The lowest point of each cell, gathered tile by tile in square blocks, so that far strays cost nothing."""

    BLOCK = 128

    def __init__(self, spacing_m: float, cell_m: float | None = None) -> None:
        """`cell_m` defaults to a few point spacings."""
        self.spacing_m = spacing_m
        self.cell_m = cell_m or max(MIN_CELL_M, CELL_SPACINGS * spacing_m)
        self._blocks: dict[tuple[int, int], Float] = {}

    def add(self, points: Float) -> None:
        """Add points (N, 3)."""
        column, row = np.floor(points[:, :2] / self.cell_m).astype(np.int64).T
        block_x, block_y = column // self.BLOCK, row // self.BLOCK
        for x, y in np.unique(np.stack([block_x, block_y]), axis=1).T:
            inside = (block_x == x) & (block_y == y)
            block = self._blocks.setdefault((int(x), int(y)), np.full((self.BLOCK, self.BLOCK), np.inf, np.float32))
            at = row[inside] - y * self.BLOCK, column[inside] - x * self.BLOCK
            np.minimum.at(block, at, points[inside, 2].astype(np.float32))

    def grid(self, extent: Extent) -> tuple[float, float, float, Float]:
        """Return west, north, cell side and lowest heights (H, W), NaN where there is no point, of an extent."""
        first = np.floor(extent.low[:2] / self.cell_m).astype(int)
        last = np.floor(extent.high[:2] / self.cell_m).astype(int)
        width, height = (last - first + 1).tolist()
        step = int(np.ceil(np.sqrt(max(1.0, width * height / MAX_CELLS))))
        shape = -(-height // step), -(-width // step)
        lowest = np.full(shape, np.inf, np.float32)
        for (x, y), block in self._blocks.items():
            row, column = np.nonzero(np.isfinite(block))
            z = block[row, column]
            column, row = column + x * self.BLOCK - first[0], last[1] - (row + y * self.BLOCK)
            ok = (column >= 0) & (row >= 0) & (column < width) & (row < height)
            ok &= (z >= extent.low[2]) & (z <= extent.high[2])
            np.minimum.at(lowest, (row[ok] // step, column[ok] // step), z[ok])
        lowest[~np.isfinite(lowest)] = np.nan
        cell = self.cell_m
        return float(first[0] * cell), float((last[1] + 1) * cell), cell * step, lowest


def find_terrain(lowest: LowestPoints, extent: Extent) -> Terrain:
    """Return the ground of an extent."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter, grey_opening

    west, north, cell_m, heights = lowest.grid(extent)
    seen = np.isfinite(heights)
    surface = interpolated(heights, seen)
    # Section 2.2: single cells far below their neighbours are blunders; the surface upside down shows them as objects.
    opened = grey_opening(-surface, size=3, mode="nearest")
    low = (-surface - opened) > LOW_SLOPE * cell_m
    surface = interpolated(surface, ~low)
    # Section 2.1: openings with a growing window; what a window takes off more than its slope allows is an object.
    objects = np.zeros(surface.shape, bool)
    last = surface
    radii = _radii(MAX_OBJECT_M / 2.0 / cell_m, max(surface.shape))
    for radius in radii:
        opened = grey_opening(last, size=2 * radius + 1, mode="nearest")
        objects |= last - opened > SLOPE * radius * cell_m
        last = opened
    ground = seen & ~low & ~objects
    if not ground.any():
        ground = seen
    filled = gaussian_filter(interpolated(surface, ground), 0.7)
    rise_y, rise_x = np.gradient(filled, cell_m) if min(filled.shape) > 1 else (np.zeros_like(filled),) * 2
    return Terrain(
        west,
        north,
        cell_m,
        filled.astype(np.float32),
        np.hypot(rise_x, rise_y).astype(np.float32),
        (distance_transform_edt(~ground) * cell_m).astype(np.float32),
        max(THRESHOLD_M, THRESHOLD_SPACINGS * lowest.spacing_m),
    )


def _radii(largest: float, side: int) -> list[int]:
    radii, radius = [], 1
    while radius <= min(largest, side):
        radii.append(radius)
        radius = max(radius + 1, int(radius * 1.4))
    return radii or [1]


def interpolated(heights: Float, known: Bool) -> Float:
    """Return heights (H, W) with unknown cells interpolated from known ones around them, far ones from the nearest."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    if known.all():
        return heights.astype(np.float32)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = np.asarray(heights[tuple(nearest)], np.float32)
    for sigma in (16.0, 8.0, 4.0, 2.0, 1.0):  # coarse to fine: a smooth patch that meets its rim
        smooth = gaussian_filter(filled, sigma)
        filled = np.where(known, filled, smooth).astype(np.float32)
    return filled
