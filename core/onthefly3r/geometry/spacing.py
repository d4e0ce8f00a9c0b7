"""How far apart the points of a cloud lie."""

from __future__ import annotations

import numpy as np

from .arrays import Float

WINDOW_POINTS = 4096


def point_spacing(points: Float, seed: int = 0) -> float:
    """Return the mean distance to the nearest neighbour in a window about one random point of (N, 3) points.

    Cheap whatever N is: only the `WINDOW_POINTS` points nearest in plan are looked at. NaN for fewer than two points.
    """
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return float("nan")
    middle = points[np.random.default_rng(seed).integers(len(points))]
    window = points
    if len(points) > WINDOW_POINTS:
        square_distance = ((points[:, :2] - middle[:2]) ** 2).sum(axis=1)
        window = points[np.argpartition(square_distance, WINDOW_POINTS)[:WINDOW_POINTS]]
    centred = window - middle
    return float(cKDTree(centred).query(centred, k=2)[0][:, 1].mean())
