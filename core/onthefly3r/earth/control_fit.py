"""The first similarity from points of the map to ground control, and control points that are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..errors import GeoreferenceError
from ..geometry.arrays import Bool, Float
from ..geometry.transforms import Sim3
from ..geometry.umeyama import weighted_similarity

MIN_CONTROL = 3
MOST_TRIPLES = 600
OUTLIER = 4.0  # robust standard deviations
NOTEWORTHY = 3.0  # times the stated accuracy: control that scatters more is told and believed less,
BENT = 0.005  # where it also scatters by this share of its extent; less may be how the block is bent before it is tied
LINE_RATIO = 0.03  # second over first extent of control that lies on one line


def control_similarity(points: Float, control_m: Float, sigma_m: Float, seed: int = 0) -> tuple[Sim3, Bool, float]:
    """Return enu_from_map, which points (N,) agree with it, and how many times their accuracy they scatter.

    Least median of squares over triples, then least squares of what agrees. Four or more points can outvote a wrong
    one. Raises `GeoreferenceError` where there are fewer than three or they lie on one line.
    """
    n = len(points)
    if n < MIN_CONTROL:
        raise GeoreferenceError(
            f"{n} control points are marked in two or more placed photographs; at least {MIN_CONTROL} are needed "
            "without positions. Mark more points, or use photographs with GPS tags"
        )
    extent = np.linalg.svd(control_m - control_m.mean(axis=0), compute_uv=False)
    if not extent[1] > LINE_RATIO * extent[0]:
        raise GeoreferenceError("the control points lie on one line: the roll about it stays open; add one beside it")
    triples = list(combinations(range(n), 3))
    if len(triples) > MOST_TRIPLES:
        chosen = np.random.default_rng(seed).choice(len(triples), MOST_TRIPLES, replace=False)
        triples = [triples[k] for k in chosen]
    best, best_score = None, np.inf
    for triple in triples:
        rows = list(triple)
        try:
            candidate = weighted_similarity(points[rows], control_m[rows], np.ones(3))
        except ValueError:
            continue
        ratio = np.sort(_misfit(candidate, points, control_m, sigma_m))
        score = float(ratio[min(n - 1, n // 2 + 1)])
        if score < best_score:
            best, best_score = candidate, score
    if best is None:
        raise GeoreferenceError("the control points lie on one line or at one place; add one beside them")
    good = np.ones(n, bool)
    scatter = 1.0
    for _ in range(10):
        ratio = _misfit(best, points, control_m, sigma_m)
        scatter = max(1.0, _scatter(ratio))
        off = np.linalg.norm(control_m - best.apply(points), axis=1)
        now = (ratio <= OUTLIER * scatter) | (off <= 2.0 * BENT * extent_m(control_m))
        now = now if n > MIN_CONTROL else np.ones(n, bool)
        if now.sum() < MIN_CONTROL:
            break
        best = weighted_similarity(points[now], control_m[now], 1.0 / np.square(sigma_m[now, 0]))
        if (now == good).all():
            break
        good = now
    return best, good, max(1.0, _scatter(_misfit(best, points, control_m, sigma_m)[good]))


def exchanged_axes(points: Float, control_m: Float, sigma_m: Float) -> bool:
    """Return whether the control fits far better with east and north exchanged, which mirrors it."""
    if len(points) <= MIN_CONTROL:
        return False
    try:
        as_given = control_similarity(points, control_m, sigma_m)[2]
        mirrored = control_similarity(points, control_m[:, [1, 0, 2]], sigma_m)[2]
    except GeoreferenceError:
        return False
    return mirrored < 0.2 * as_given


def extent_m(control_m: Float) -> float:
    """Return the greatest distance of control from its middle."""
    return float(np.linalg.norm(control_m - control_m.mean(axis=0), axis=1).max(initial=0.0))


def is_poor(scatter: float, control_m: Float, sigma_m: Float) -> bool:
    """Return whether control scatters far more than it states, and more than a block may be bent."""
    return scatter > NOTEWORTHY and scatter * float(np.median(sigma_m[:, 0])) > BENT * extent_m(control_m)


def scatter_warning(labels: Sequence[str], scatter: float, sigma_m: Float) -> list[str]:
    """Return what to say of control that scatters far more than it states."""
    stated = float(np.median(sigma_m[:, 0]))
    return [
        f"control: the {len(labels)} points scatter {scatter * stated:.2g} m about the block where {stated:.2g} m is "
        "stated or assumed; they are believed only as far as they scatter"
    ]


def _misfit(enu_from_map: Sim3, points: Float, control_m: Float, sigma_m: Float) -> Float:
    return np.asarray(np.linalg.norm((control_m - enu_from_map.apply(points)) / sigma_m, axis=1))


def _scatter(ratio: Float) -> float:
    """Return the robust standard deviation of misfits that are lengths in three dimensions, few of them fitted."""
    n = len(ratio)
    return float(np.median(ratio)) / 1.538 * float(np.sqrt(3.0 * n / max(3.0 * n - 7.0, 1.0)))
