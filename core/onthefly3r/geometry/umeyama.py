"""Closed-form similarity between two weighted point sets (Umeyama 1991).

S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE TPAMI 13(4),
1991, equations 34-43 there; weights enter the means and the covariance.
"""

from __future__ import annotations

import numpy as np

from .arrays import Float
from .transforms import Sim3

# Second over first singular value of the covariance below which points count as lying on one line.
MIN_SINGULAR_RATIO = 1e-10


def weighted_similarity(source: Float, target: Float, weight: Float, *, with_scale: bool = True) -> Sim3:
    """Return target_from_source minimising sum(weight * |target - target_from_source(source)|^2) (paper Eq. 11).

    Args:
        source: (N, 3) points.
        target: (N, 3) points in the same order.
        weight: (N,) weights >= 0, any scale; points of weight 0 do not count.
        with_scale: False keeps scale 1 (a rigid fit).

    Raises:
        ValueError: shapes differ, a number is not finite, a weight is negative, or the points leave the rotation
            open: fewer than three, all at one place, or all on one line.
    """
    source, target, weight = np.asarray(source, float), np.asarray(target, float), np.asarray(weight, float)
    if source.ndim != 2 or source.shape[1] != 3 or target.shape != source.shape or weight.shape != source.shape[:1]:
        raise ValueError(f"need (N, 3), (N, 3), (N,); got {source.shape}, {target.shape}, {weight.shape}")
    if not (np.isfinite(source).all() and np.isfinite(target).all() and np.isfinite(weight).all()):
        raise ValueError("points and weights must be finite")
    if (weight < 0.0).any():
        raise ValueError("weights must not be negative")
    if np.count_nonzero(weight) < 3:
        raise ValueError(f"need at least 3 points with weight, got {np.count_nonzero(weight)}")

    share = weight / weight.sum()
    source_mean, target_mean = share @ source, share @ target
    source_centred, target_centred = source - source_mean, target - target_mean
    covariance = np.einsum("ni,nj->ij", target_centred * share[:, None], source_centred)
    u, singular, vt = np.linalg.svd(covariance)
    if singular[0] <= 0.0 or singular[1] <= MIN_SINGULAR_RATIO * singular[0]:
        raise ValueError("the points lie at one place or on one line; the rotation is not determined")
    # The sign keeps det(R) = +1: the best rotation even where a reflection would fit better.
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = np.asarray((u * sign) @ vt)
    variance = float(share @ (source_centred**2).sum(axis=1))
    scale = float(singular @ sign) / variance if with_scale else 1.0
    return Sim3(scale, rotation, target_mean - scale * (rotation @ source_mean))
