"""Averages of the depth maps that agree about a point, taken along the ray of each pixel, and who agrees.

Each pixel of a photograph becomes a point, and each neighbour is asked what it sees where that point should be. One
that sees a surface there agrees, and its depth takes part in the mean; one that sees a surface farther off looks
through the point and speaks against it; one that sees something nearer is hidden and says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float, UInt8
from .views import PixelTransfer, View

AGREEMENT_PX = 1.0  # of disparity between the two photographs,
NARROW = 0.05  # whose baseline counts as at least this part of the depth;
MOST_GSD = 8.0  # no difference beyond so many ground sampling distances agrees
THROUGH = 3.0  # tolerances behind the point: a neighbour looks through it
BAND_ROWS = 64  # fits the processor's cache


@dataclass(frozen=True)
class Averaged:
    """One photograph's depths after asking its neighbours."""

    depth: Float  # (H, W) float32, mean of those that agree; 0 where unknown
    support: UInt8  # (H, W) neighbours that agree
    against: UInt8  # (H, W) neighbours that look through the point
    seniors: UInt8  # (H, W) of those that agree, the ones that see the point closer to the middle of their picture


def average(view: View, depth: Float, neighbours: Sequence[tuple[View, Float]]) -> Averaged:
    """Return the averages of a depth map (H, W), 0 where unknown, with the depth maps of neighbours."""
    height, width = depth.shape
    mean = np.zeros((height, width), np.float32)
    support, against, seniors = (np.zeros((height, width), np.uint8) for _ in range(3))
    judges = [_Judge(view, other, other_depth) for other, other_depth in neighbours]
    for top in range(0, height, BAND_ROWS):
        band = slice(top, min(top + BAND_ROWS, height))
        mean[band], support[band], against[band], seniors[band] = _average_band(view, depth[band], top, judges)
    return Averaged(mean, support, against, seniors)


def _average_band(view: View, depth: Float, top: int, judges: Sequence[_Judge]) -> tuple[Float, UInt8, UInt8, UInt8]:
    rows, columns = depth.shape
    x = (np.arange(columns) + 0.5).astype(np.float32)
    y = (np.arange(top, top + rows) + 0.5).astype(np.float32)[:, None]
    known = depth > 0.0
    off_axis = ((x - np.float32(view.grid.cx)) ** 2 + (y - np.float32(view.grid.cy)) ** 2) / np.float32(view.grid.fx**2)
    total, number = np.ones_like(depth), np.ones_like(depth)  # of depths relative to the pixel's own
    support, against, seniors = (np.zeros(depth.shape, np.uint8) for _ in range(3))
    for judge in judges:
        ratio, agrees, through, senior = judge.verdict(depth, x, y, off_axis)
        agrees &= known
        total += np.where(agrees, ratio, np.float32(0.0))
        number += agrees
        support += agrees
        against += through & known
        seniors += senior & agrees
    return np.where(known, depth * total / number, np.float32(0.0)), support, against, seniors


class _Judge:
    """One neighbour's depth map and how to get there."""

    def __init__(self, view: View, other: View, depth: Float) -> None:
        transfer = PixelTransfer.between(view, other)
        self._matrix, self._offset = transfer.matrix.astype(np.float32), transfer.offset.astype(np.float32)
        self._depth, self._grid = depth, other.grid
        self._first = other.shot.name < view.shot.name  # of equally good ones
        shift = other.level_from_cam.translation - view.level_from_cam.translation
        self._baseline = np.float32(np.linalg.norm(shift))

    def verdict(self, depth: Float, x: Float, y: Float, off_axis: Float) -> tuple[Float, Bool, Bool, Bool]:
        """Return (depth there over depth expected, agrees, looks through, sees it closer to its axis), each (h, w)."""
        import cv2

        m, b = self._matrix, self._offset
        u, v, z = (depth * (m[k, 0] * x + (m[k, 1] * y + m[k, 2])) + b[k] for k in range(3))
        focal = np.float32(self._grid.fx)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u /= z
            v /= z
            found = cv2.remap(
                self._depth,
                u - np.float32(0.5),
                v - np.float32(0.5),
                cv2.INTER_NEAREST,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=0.0,
            )
            seen = (found > 0.0) & (z > 0.0)
            tolerance = np.minimum(
                np.float32(AGREEMENT_PX) * z / np.maximum(self._baseline, np.float32(NARROW) * z), np.float32(MOST_GSD)
            ) * (z / focal)
            difference = found - z
            agrees = seen & (np.abs(difference) < tolerance)
            through = seen & (difference > np.float32(THROUGH) * tolerance)
            their_axis = ((u - np.float32(self._grid.cx)) ** 2 + (v - np.float32(self._grid.cy)) ** 2) / focal**2
            ratio = found / z
        senior = (their_axis < off_axis) | ((their_axis == off_axis) & self._first)
        return ratio, agrees, through, senior
