"""The epipolar geometry of two images, and nearest neighbours within epipolar planes.

Rays (N, 3) have z = 1 in their camera; a geometry is a matrix E with r2' E r1 = 0 for rays of one point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float, Int

MAX_TRIALS = 1000
CONFIDENCE = 0.9999
MIN_ERROR_PX = 2.0  # that a match may have, for the estimate from few features
BLOCK = 128  # features of the first image compared at once
NEAR_EPIPOLE = 0.1  # sine of the angle to the epipole, below which all planes are near


@dataclass(frozen=True)
class RelativeGeometry:
    """How two images lie to each other, and which of the matches it was found from agree."""

    matrix: Float  # (3, 3)
    inliers: Bool  # (M,)


def relative_geometry(
    first: Float, second: Float, focal_px: float, max_error_px: float, min_inliers: int
) -> RelativeGeometry | None:
    """Return the essential matrix that most matched rays (M, 3) agree on, or None with fewer than `min_inliers`.

    Sampling and scoring are OpenCV's (MAGSAC++, Barath et al. 2020), seeded: the same rays give the same answer.
    """
    import cv2

    if len(first) < min_inliers:
        return None
    camera = np.diag([focal_px, focal_px, 1.0])  # OpenCV's thresholds are in pixels
    pixels = [np.ascontiguousarray(rays[:, :2] * focal_px) for rays in (first, second)]
    try:
        matrix, inliers = cv2.findEssentialMat(
            pixels[0],
            pixels[1],
            camera,
            method=cv2.USAC_MAGSAC,
            prob=CONFIDENCE,
            threshold=max(MIN_ERROR_PX, max_error_px),
            maxIters=MAX_TRIALS,
        )
    except cv2.error:  # degenerate samples only
        return None
    if matrix is None or inliers is None or matrix.shape != (3, 3):
        return None
    agreeing = inliers.ravel() > 0
    if np.count_nonzero(agreeing) < min_inliers:
        return None
    return RelativeGeometry(matrix, agreeing)


def guided_neighbours(
    matrix: Float, first: Float, second: Float, first_vectors: Float, second_vectors: Float, band: float
) -> tuple[Int, Int, Float, Float]:
    """Return mutual nearest neighbours among features whose rays lie in one epipolar plane.

    Both images are sorted by the angle of their epipolar planes about the baseline, so that every block of one meets
    only a narrow range of the other.

    Args:
        matrix: E (3, 3).
        first, second: rays (N, 3) and (M, 3).
        first_vectors, second_vectors: descriptors (N, D) and (M, D), compared by their products.
        band: largest angle of a ray from the plane, rad.

    Returns:
        Rows of the first and of the second image (K,), their products, and the best other product of the first one
        within its plane, -inf where there is none.
    """
    axis = np.linalg.svd(matrix)[0][:, 2]  # the first camera's centre seen from the second
    planes = first @ matrix.T
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-12)
    rays = second / np.linalg.norm(second, axis=1, keepdims=True)
    across = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    normal = np.cross(axis, across)
    sines = np.cross(axis, rays)  # normals of the planes through the second image's rays
    angle1, angle2 = (np.arctan2(n @ normal, n @ across) for n in (planes, sines))
    # Planes are the same after half a turn: angles run from 0 to pi, and begin anew beside either end.
    middle = 0.5 * np.angle(np.exp(2j * angle2).mean()) if len(angle2) else 0.0
    angle1, angle2 = ((a - middle + 0.5 * np.pi) % np.pi for a in (angle1, angle2))
    widths = band / np.maximum(np.linalg.norm(sines, axis=1), NEAR_EPIPOLE)
    pad = float(widths.max(initial=0.0))
    order1, order2 = np.argsort(angle1, kind="stable"), np.argsort(angle2, kind="stable")
    ends = np.searchsorted(angle2[order2], [pad, np.pi - pad])
    column = np.concatenate([order2[ends[1] :], order2, order2[: ends[0]]])
    turns = np.repeat([-np.pi, 0.0, np.pi], [len(order2) - ends[1], len(order2), ends[0]])
    place = angle2[column] + turns
    planes, rays, vectors = planes[order1].astype(np.float32), rays[column].astype(np.float32), second_vectors[column]
    best = np.zeros(len(first), np.int64)
    nearest, runner_up = np.full((2, len(first)), -np.inf, np.float32)
    column_best = np.full(len(column), -np.inf, np.float32)
    for start in range(0, len(first), BLOCK):
        rows = order1[start : start + BLOCK]
        low, high = np.searchsorted(place, [angle1[rows[0]] - pad, angle1[rows[-1]] + pad])
        if angle1[rows[-1]] - angle1[rows[0]] + 2.0 * pad >= np.pi:  # every plane, but none twice
            low, high = len(order2) - ends[1], 2 * len(order2) - ends[1]
        if low == high:
            continue
        products = first_vectors[rows] @ vectors[low:high].T
        products[np.abs(planes[start : start + BLOCK] @ rays[low:high].T) > band] = -np.inf
        np.maximum(column_best[low:high], products.max(axis=0), out=column_best[low:high])
        here, chosen = np.arange(len(rows)), products.argmax(axis=1)
        best[rows], nearest[rows] = column[low + chosen], products[here, chosen]
        products[here, chosen] = -np.inf
        runner_up[rows] = products.max(axis=1)
    second_best = np.full(len(second), -np.inf, np.float32)
    np.maximum.at(second_best, column, column_best)
    mutual = np.flatnonzero(np.isfinite(nearest) & (nearest >= second_best[best]))
    return mutual, best[mutual], nearest[mutual], runner_up[mutual]
