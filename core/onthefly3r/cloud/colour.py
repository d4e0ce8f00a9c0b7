"""One gain per photograph and channel, so that the block has one exposure.

The logarithm of what two photographs show of the same point differs by the logarithms of their gains; least squares
over all overlaps, robust, pulled to no change. A fall-off towards the corners of the pictures was tried: it gains
nothing once the gains are right.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.arrays import Float, UInt8
from .alignment import Comparison

ROUNDS = 6
PULL = 1e-3
SMOOTHING_PX = 9  # colours are compared as means over so many pixels


def smoothed(rgb: UInt8) -> UInt8:
    """Return a picture (H, W, 3) in which noise and small misfits no longer matter."""
    import cv2

    return np.asarray(cv2.blur(rgb, (SMOOTHING_PX, SMOOTHING_PX)))


def gains(indices: Sequence[int], comparisons: Sequence[Comparison]) -> dict[int, Float]:
    """Return the factors (3,) by which to multiply the colours of each photograph; their mean logarithm is 0."""
    from scipy.sparse import coo_matrix, identity
    from scipy.sparse.linalg import spsolve

    row_of = {index: row for row, index in enumerate(indices)}
    n = len(indices)
    fair = [item for item in comparisons if np.isfinite(item.log_colour[:, 0]).any()]
    if not fair:
        return {index: np.ones(3) for index in indices}
    kept = [item.log_colour[np.isfinite(item.log_colour[:, 0])] for item in fair]
    measured = np.concatenate(kept)
    first = np.concatenate([np.full(len(k), row_of[item.first]) for item, k in zip(fair, kept, strict=True)])
    second = np.concatenate([np.full(len(k), row_of[item.second]) for item, k in zip(fair, kept, strict=True)])
    m = len(measured)
    rows = np.arange(m)
    matrix = coo_matrix(
        (np.repeat([1.0, -1.0], m), (np.concatenate([rows, rows]), np.concatenate([first, second]))), shape=(m, n)
    ).tocsr()
    log_brightness = np.zeros((n, 3))
    for channel in range(3):
        for _ in range(ROUNDS):
            residual = measured[:, channel] - matrix @ log_brightness[:, channel]
            scale = 2.0 * 1.4826 * float(np.median(np.abs(residual))) + 1e-6
            weighted = matrix.multiply((1.0 / (1.0 + (residual / scale) ** 2))[:, None]).tocsr()
            normal = (matrix.T @ weighted + PULL * m / n * identity(n)).tocsc()
            log_brightness[:, channel] = spsolve(normal, weighted.T @ measured[:, channel])
    log_brightness -= log_brightness.mean(axis=0)
    return {index: np.exp(-log_brightness[row]) for index, row in row_of.items()}


def harmonised(rgb: UInt8, gain: Float) -> UInt8:
    """Return colours (..., 3) with the gain of their photograph."""
    table = np.clip(np.rint(np.arange(256)[:, None] * gain), 0, 255).astype(np.uint8)
    return np.stack([table[rgb[..., channel], channel] for channel in range(3)], axis=-1)
