"""Keypoints of a grey image: extrema of the difference of Gaussians, spread over the image (Lowe 2004).

The first octave is the image itself, not its double: on drone photographs reduced to working size the doubled octave
costs four times as much and adds few matches. Positions here count from the centre of the first pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..geometry.arrays import Bool, Float, Int, UInt8

SIGMA = 1.6  # of the first level of an octave, in its pixels
INPUT_SIGMA = 0.5  # blur that photographs have
LAYERS = 3  # of an octave in which extrema are looked for
STEP = 2.0 ** (1.0 / LAYERS)  # from level to level
MAX_OCTAVES = 5
MIN_SIDE_PX = 24  # of an octave
BORDER_PX = 5
EDGE_RATIO = 10.0  # of the principal curvatures: beyond it, an extremum slides along an edge
REFITS = 1  # of the parabola, where the first peaks
MOVED_BEYOND = 0.6  # pixels or layers from where it was fitted
MAX_STEP = 0.8  # from the last fit to its peak
CELLS = 140  # over which keypoints are spread
# Contrast of an extremum, of the range of brightness. So low that crops, snow and sand have keypoints; where there are
# more than wanted, those of higher contrast win in each cell.
MIN_CONTRAST = 0.001


@dataclass(frozen=True)
class Octave:
    """Gaussian levels of one octave, float32 in 0..1; level i has the blur `SIGMA * STEP**i` in its own pixels."""

    levels: Sequence[Float]
    scale: float  # pixels of the image per pixel of the octave


@dataclass(frozen=True)
class Keypoints:
    """Extrema of all octaves, in the pixels of their octave, best spread first."""

    octave: Int  # (N,)
    level: Int  # (N,) whose blur is nearest to that of the extremum
    xy: Float  # (N, 2) float32
    layer: Float  # (N,) float32, level with a fraction

    def of_octave(self, octave: int) -> Int:
        """Return the rows of one octave."""
        return np.flatnonzero(self.octave == octave)

    def pixels(self) -> Float:
        """Return positions (N, 2) float32 in the image, from the centre of its first pixel."""
        return self.xy * np.float32(2.0) ** self.octave[:, None].astype(np.float32)

    def scales(self) -> Float:
        """Return the blur (N,) float32 of the extrema, px of the image."""
        return np.float32(SIGMA) * np.float32(2.0) ** (self.octave + self.layer / LAYERS).astype(np.float32)


def scale_space(grey: UInt8) -> list[Octave]:
    """Return the octaves of an image (H, W)."""
    import cv2

    base = cv2.multiply(grey, np.array([1.0 / 255.0]), dtype=cv2.CV_32F)
    base = cv2.GaussianBlur(base, (0, 0), float(np.sqrt(SIGMA**2 - INPUT_SIGMA**2)))
    octaves: list[Octave] = []
    while len(octaves) < MAX_OCTAVES and min(base.shape) >= MIN_SIDE_PX:
        levels = [base]
        for i in range(LAYERS + 2):
            more = SIGMA * STEP**i * np.sqrt(STEP**2 - 1.0)
            levels.append(cv2.GaussianBlur(levels[-1], (0, 0), float(more)))
        octaves.append(Octave(levels, 2.0 ** len(octaves)))
        base = np.ascontiguousarray(levels[LAYERS][::2, ::2])
    return octaves


def find_keypoints(octaves: Sequence[Octave], shape: tuple[int, int], count: int) -> Keypoints:
    """Return up to `count` keypoints of an image of (height, width) `shape`, every part of it served alike."""
    parts = [_extrema(octave.levels) for octave in octaves]
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    table = np.concatenate([*parts, np.zeros((0, 5), np.float32)])
    scale = np.float32(2.0) ** number.astype(np.float32)
    chosen = _spread(table[:, 0] * scale, table[:, 1] * scale, table[:, 4], shape, count)
    table = table[chosen]
    return Keypoints(number[chosen], table[:, 3].astype(np.int64), table[:, :2], table[:, 2])


def _extrema(levels: Sequence[Float]) -> Float:
    """Return x, y, layer, level, contrast (N, 5) float32 of the extrema of one octave, refined by a parabola."""
    import cv2

    difference = np.stack([cv2.subtract(finer, coarser) for coarser, finer in pairwise(levels)])
    _, height, width = difference.shape
    flat = difference.ravel()
    block = np.ones((3, 3), np.uint8)
    start = 0.8 * MIN_CONTRAST  # the refined extremum is higher than the pixel's
    places = []
    for s in range(1, LAYERS + 1):
        here = difference[s]
        # Within its own layer first: the few that remain are compared with the layers above and below.
        highest = cv2.min(cv2.compare(here, cv2.dilate(here, block), cv2.CMP_GE), cv2.compare(here, start, cv2.CMP_GT))
        lowest = cv2.min(cv2.compare(here, cv2.erode(here, block), cv2.CMP_LE), cv2.compare(here, -start, cv2.CMP_LT))
        found = cv2.max(highest, lowest)
        found[:BORDER_PX] = found[-BORDER_PX:] = found[:, :BORDER_PX] = found[:, -BORDER_PX:] = 0
        at = np.flatnonzero(found.view(np.bool_)) + s * height * width
        for layer in (-height * width, height * width):
            for beside in (0, -1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1):
                value = flat[at]
                at = at[np.abs(value) >= np.sign(value) * flat[at + (layer + beside)]]
        places.append(at)
    return _refined(flat, np.concatenate(places), height, width)


def _refined(flat: Float, at: Int, height: int, width: int) -> Float:
    """Return the table of `_extrema` without those on edges and those that no parabola peaks near.

    A parabola that peaks nearer to another pixel or layer is fitted there anew.
    """
    shape = np.array([LAYERS + 2, height, width])
    for _ in range(REFITS):
        step, _, good = _parabola(flat, at, width, height * width)
        by = np.where(np.abs(step) > MOVED_BEYOND, np.sign(step), 0.0).astype(np.int64)
        place = np.stack(np.unravel_index(at, shape), axis=-1) + by[:, ::-1]
        good &= ((place >= 1) & (place < shape - 1)).all(axis=1)
        at = np.unique(np.ravel_multi_index(place[good].T, shape))
    step, contrast, good = _parabola(flat, at, width, height * width)
    good &= (np.abs(step) <= MAX_STEP).all(axis=1) & (contrast > MIN_CONTRAST)
    s, y, x = np.unravel_index(at, shape)
    return np.column_stack([np.column_stack([x, y, s]) + step, s, contrast])[good].astype(np.float32)


def _parabola(flat: Float, at: Int, row: int, layer: int) -> tuple[Float, Float, Bool]:
    """Fit parabolas at places (N,): return the steps (N, 3) to their peaks, contrasts (N,) there, and which are blobs.

    `row` and `layer` are how far rows and layers lie apart in `flat`.
    """
    stride = (1, row, layer)  # x, y, layer

    def taken(offset: int) -> Float:
        return flat[at + offset].astype(np.float64)

    centre = taken(0)
    gradient = np.empty((len(at), 3))
    hessian = np.empty((len(at), 3, 3))
    for i, a in enumerate(stride):
        after, before = taken(a), taken(-a)
        gradient[:, i] = 0.5 * (after - before)
        hessian[:, i, i] = after + before - 2.0 * centre
        for j, b in enumerate(stride[:i]):
            mixed = 0.25 * (taken(a + b) + taken(-a - b) - taken(a - b) - taken(b - a))
            hessian[:, i, j] = hessian[:, j, i] = mixed
    trace = hessian[:, 0, 0] + hessian[:, 1, 1]
    determinant = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    good = (determinant > 0.0) & (trace**2 * EDGE_RATIO < (EDGE_RATIO + 1.0) ** 2 * determinant)
    good &= np.abs(np.linalg.det(hessian)) > 1e-20
    hessian[~good] = np.eye(3)
    step = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
    return step, np.abs(centre + 0.5 * (gradient * step).sum(axis=1)), good


def _spread(x: Float, y: Float, contrast: Float, shape: tuple[int, int], count: int) -> Int:
    """Return the rows of up to `count` keypoints: the strongest of each cell first, then the second of each, and so on.

    The first so many of them are spread over the image as well as all are.
    """
    height, width = shape
    side = np.sqrt(height * width / CELLS)
    rows, columns = max(1, round(height / side)), max(1, round(width / side))
    row = np.clip(y * rows / height, 0, rows - 1).astype(np.int64)
    column = np.clip(x * columns / width, 0, columns - 1).astype(np.int64)
    cell = row * columns + column
    order = np.lexsort((-contrast, cell))
    first = np.searchsorted(cell[order], np.arange(rows * columns))
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - first[cell[order]]
    return np.lexsort((-contrast, rank))[:count]
