"""Confidence-weighted robust Sim(3) of a local model to the map (Eq. 11)."""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Sim3, skew
from ..geometry.umeyama import weighted_similarity
from ..records import Alignment, Correspondences, Rejection

MIN_POINTS = 12
MAX_ITERATIONS = 20
HUBER = 1.345  # in robust standard deviations: 95 % efficiency on Gaussian residuals
INLIER = 3.0  # in robust standard deviations
# Points of one image err together (its pose, its depth scale): an image counts as so many independent points.
INDEPENDENT_POINTS_PER_REFERENCE = 12


def align(pairs: Correspondences, images: tuple[int, ...] = ()) -> Alignment | Rejection:
    """Return map_from_local minimising Eq. 11, closed form first, then iteratively reweighted with Huber.

    The kernel's width follows the residuals (median absolute deviation), so it needs no unit. `images` are named
    in the `Rejection` that answers too few or degenerate correspondences.
    """
    if len(pairs.weight) < MIN_POINTS:
        return Rejection(images, "alignment", "too few corresponding points", {"points": float(len(pairs.weight))})
    weight = pairs.weight
    try:
        map_from_local = weighted_similarity(pairs.local, pairs.map, weight)
        for _ in range(MAX_ITERATIONS):
            distance = _residual(map_from_local, pairs)
            spread = _spread(distance)
            kappa = HUBER * max(spread, 1e-12)
            huber = np.minimum(1.0, kappa / np.maximum(distance, 1e-300))
            updated = weighted_similarity(pairs.local, pairs.map, weight * huber)
            change = np.abs(updated.matrix() - map_from_local.matrix()).max() / updated.scale
            map_from_local = updated
            if change < 1e-9:
                break
    except ValueError as degenerate:
        return Rejection(images, "alignment", f"degenerate correspondences: {degenerate}")
    distance = _residual(map_from_local, pairs)
    spread = _spread(distance)
    inlier = distance <= INLIER * max(spread, 1e-12)
    references = tuple(int(i) for i in np.unique(pairs.reference))
    return Alignment(
        map_from_local=map_from_local,
        covariance=_covariance(pairs.local[inlier], spread / map_from_local.scale, len(references)),
        inlier_ratio=float(inlier.mean()),
        residual=float(spread),
        n_points=len(distance),
        references=references,
    )


def _residual(map_from_local: Sim3, pairs: Correspondences) -> Float:
    return np.asarray(np.linalg.norm(map_from_local.apply(pairs.local) - pairs.map, axis=1))


def _spread(distance: Float) -> float:
    # The length of a 3D Gaussian error has its median at 1.538 standard deviations.
    return float(np.median(distance)) / 1.538


def _covariance(points: Float, sigma: float, n_references: int) -> Float:
    """Covariance (7, 7) of [rotation, translation, log scale], a right perturbation in the local frame.

    A small change moves a local point p by w x p + u + lambda p, so its Jacobian is [-[p]x, I, p].
    """
    information = np.zeros((7, 7))
    for start in range(0, len(points), 4096):
        block = points[start : start + 4096]
        jacobian = np.zeros((len(block), 3, 7))
        jacobian[:, :, :3] = -np.array([skew(p) for p in block])
        jacobian[:, :, 3:6] = np.eye(3)
        jacobian[:, :, 6] = block
        information += np.einsum("nij,nik->jk", jacobian, jacobian)
    independent = INDEPENDENT_POINTS_PER_REFERENCE * max(n_references, 1)
    share = min(1.0, independent / max(len(points), 1))
    return np.asarray(sigma**2 * np.linalg.pinv(information * share, hermitian=True))
