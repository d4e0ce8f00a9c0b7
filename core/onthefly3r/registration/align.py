"""Confidence-weighted robust Sim(3) of a local model to the map (Eq. 11)."""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import skew
from ..geometry.umeyama import weighted_similarity
from ..records import Alignment, Correspondences, Rejection

MIN_POINTS = 12
MAX_ITERATIONS = 20
SETTLED = 1e-3  # iterations end when no point moves by more than so many robust standard deviations
HUBER = 1.345  # in robust standard deviations: 95 % efficiency on Gaussian residuals
INLIER = 3.0  # in robust standard deviations
# Points of one image err together (its pose, its depth scale): an image counts as so many independent points, as
# many as fix a rigid body.
INDEPENDENT_POINTS_PER_REFERENCE = 3


def align(pairs: Correspondences, images: tuple[int, ...] = ()) -> Alignment | Rejection:
    """Return map_from_local minimising Eq. 11, closed form first, then iteratively reweighted with Huber.

    The kernel's width follows the residuals (median absolute deviation), so it needs no unit. `images` are named
    in the `Rejection` that answers too few or degenerate correspondences.
    """
    if len(pairs.weight) < MIN_POINTS:
        return Rejection(images, "alignment", "too few corresponding points", {"points": float(len(pairs.weight))})
    rounding = 1e-12 * float(np.abs(pairs.map).max())  # residuals below it are no measure of anything
    try:
        map_from_local = weighted_similarity(pairs.local, pairs.map, pairs.weight)
        placed = map_from_local.apply(pairs.local)
        for _ in range(MAX_ITERATIONS):
            distance = np.linalg.norm(placed - pairs.map, axis=1)
            spread = max(_spread(distance), rounding)
            huber = np.minimum(1.0, HUBER * spread / np.maximum(distance, rounding))
            map_from_local = weighted_similarity(pairs.local, pairs.map, pairs.weight * huber)
            before, placed = placed, map_from_local.apply(pairs.local)
            if np.abs(placed - before).max() <= SETTLED * spread:
                break
    except ValueError as degenerate:
        return Rejection(images, "alignment", f"degenerate correspondences: {degenerate}")
    distance = np.linalg.norm(placed - pairs.map, axis=1)
    spread = max(_spread(distance), rounding)
    inlier = distance <= INLIER * spread
    references = tuple(int(i) for i in np.unique(pairs.reference))
    return Alignment(
        map_from_local=map_from_local,
        covariance=_covariance(pairs.local[inlier], spread / map_from_local.scale, len(references)),
        inlier_ratio=float(inlier.mean()),
        residual=spread,
        n_points=len(distance),
        references=references,
    )


def _spread(distance: Float) -> float:
    # The length of a 3D Gaussian error has its median at 1.538 standard deviations.
    return float(np.median(distance)) / 1.538


def _covariance(points: Float, sigma: float, n_references: int) -> Float:
    """Covariance (7, 7) of [rotation, translation, log scale], a right perturbation in the local frame.

    A small change moves a local point p by w x p + u + lambda p, so its Jacobian is [-[p]x, I, p]. The sums are
    taken about the middle of the points and in units of their extent, where they are well conditioned.
    """
    middle = points.mean(axis=0)
    centred = points - middle
    extent = float(np.sqrt((centred**2).sum(axis=1).mean()))
    moment = np.einsum("ni,nj->ij", centred, centred) / (len(points) * extent**2)
    information = np.eye(7)
    information[:3, :3] = np.eye(3) - moment
    independent = min(len(points), INDEPENDENT_POINTS_PER_REFERENCE * n_references)
    about_middle = np.linalg.pinv(independent * information, hermitian=True) * (sigma / extent) ** 2
    # u = extent u' - w x middle - lambda middle: the same motion seen from the origin of the local frame.
    to_origin = np.eye(7)
    to_origin[3:6, 3:6] *= extent
    to_origin[3:6, :3] = skew(middle)
    to_origin[3:6, 6] = -middle
    return np.asarray(to_origin @ about_middle @ to_origin.T)
