"""Self-calibration by evidence: what of a lens the images tell is free, what they do not tell is held by its prior.

Over weak geometry a wrong lens costs less than what a rolling shutter leaves in the residuals, and formal covariances
do not see that, because the residuals of one image share their causes. So the question who decides, images or prior, is
asked with every image counting as a few observations. What the images decide then is estimated with all of them at
full weight; the prior of the rest is made as strong as the images became.

The principal point bends a whole block when it is wrong, whether held or free. It is freed where the images tell it,
where tracks that had no part in the estimate agree better with it, and where the pixels stay square: one that absorbs
a rolling shutter takes the shape of the pixels along.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from .bundle import HUBER, Bundle, State
from .intrinsics import PARAMETERS, WITHOUT_PRINCIPAL_POINT

PrincipalPoint = Literal["auto", "free", "held"]
EFFECTIVE_OBSERVATIONS = 10.0  # that one image counts as where it is asked who decides
HELD_TANGENTIAL = 3.0  # times stronger is the prior of the tangential terms where the principal point is held
TOLD = 0.5  # posterior over prior standard deviation below which the images decide
SQUARE = 0.003  # log of fx / fy beyond which no sensor's pixels are
CONFIDENT = 2.0  # standard errors by which held-out tracks must agree better
HELD_OUT = 5  # every fifth track
CHECKED_OBSERVATIONS = 12_000
LEAST_PER_IMAGE = 30  # observations
NOISE_ROUNDS = 2  # how often the pixel noise is estimated anew
INTERSECTIONS = 4  # steps
ASPECT = PARAMETERS.index("log_aspect")
CENTRE = slice(PARAMETERS.index("centre_x"), PARAMETERS.index("centre_y") + 1)
TANGENTIAL = slice(PARAMETERS.index("p1"), PARAMETERS.index("p2") + 1)


@dataclass(frozen=True)
class Calibrated:
    """A settled bundle with the weights, priors and free terms that were decided on."""

    bundle: Bundle
    state: State
    noise_px: float
    told: Float  # (K, 8) posterior over prior standard deviation, every image counting as a few observations
    verdict: Mapping[str, str]  # by free camera key: what became of the principal point, and why
    iterations: int


def calibrate(bundle: Bundle, start: State, principal_point: PrincipalPoint = "auto") -> Calibrated:
    """Return the state of least cost, with the principal point free where `principal_point` or the evidence says so.

    `bundle` holds all observations at full weight, and priors that are wide enough to lose against evidence. Raises
    `LinAlgError` or `RuntimeError` where the equations are singular.
    """
    fit, unseen = _parts(bundle)
    point_free = np.full(len(bundle.free), principal_point != "held")
    thin, state = _of_points(bundle, start, fit)
    weight, adjustable = effective_weight(thin.image), WITHOUT_PRINCIPAL_POINT | point_free[:, None]
    tempered = replace(thin, weight=weight, adjustable=adjustable)
    state, used = settled(tempered, state)
    told = _told(tempered, state)
    verdict = dict.fromkeys(bundle.free, f"{principal_point} as asked for")
    if principal_point == "auto":
        point_free = told[:, CENTRE].max(axis=1, initial=0.0) < TOLD
        verdict = dict.fromkeys(bundle.free, "held: the images do not tell it")
        test = _of_points(bundle, start, unseen)
        for k in np.flatnonzero(point_free).tolist():
            verdict[bundle.free[k]], point_free[k] = _checked(thin, state, test, told, point_free, k)
    final = _decided(bundle, told, point_free)
    whole = _centred(replace(state, points=start.points), bundle, point_free)
    state, rest = settled(final, intersect(final, whole))
    return Calibrated(final, state, final.noise_px(state), told, verdict, used + rest)


def settled(bundle: Bundle, state: State, rounds: int = NOISE_ROUNDS) -> tuple[State, int]:
    """Return the state of least cost near this one, the noise estimated anew in every round, and the iterations."""
    iterations = 0
    for _ in range(rounds):
        state, used = bundle.minimised(state, bundle.noise_px(state))
        iterations += used
    return state, iterations


def effective_weight(image: Int) -> Float:
    """Return the weights (M,) under which the observations of one image, named by its row, count as a few."""
    count = np.bincount(image)
    return np.asarray(np.minimum(1.0, EFFECTIVE_OBSERVATIONS / np.maximum(count, 1))[image])


def _told(bundle: Bundle, state: State) -> Float:
    """Return posterior over prior standard deviations (K, 8) of what the priors are about."""
    covariance = bundle.normal_equations(state, bundle.noise_px(state)).shared_covariance()
    size = len(PARAMETERS)
    ratio = np.ones((len(bundle.free), size))
    for k, whitening in enumerate(bundle.whitening):
        own = covariance[k * size : (k + 1) * size, k * size : (k + 1) * size]
        ratio[k] = np.sqrt(np.maximum(np.diag(whitening @ own @ whitening.T), 0.0))
    return np.minimum(ratio, 1.0)


def _decided(bundle: Bundle, told: Float, free: Bool) -> Bundle:
    """Return the bundle in which the images decide what they tell; the rest has priors as strong as before."""
    strength = 1.0 / float(effective_weight(bundle.image).mean())
    whitening = bundle.whitening.copy()
    whitening[~free, TANGENTIAL] *= HELD_TANGENTIAL
    return replace(
        bundle,
        whitening=whitening,
        prior_weight=np.where(told < TOLD, 1.0, strength),
        adjustable=WITHOUT_PRINCIPAL_POINT | free[:, None],
    )


def _centred(state: State, bundle: Bundle, free: Bool) -> State:
    """Return the state with the principal points that are held where their priors have them."""
    intrinsics = state.intrinsics.copy()
    intrinsics[~free, CENTRE] = bundle.mean[~free, CENTRE]
    return replace(state, intrinsics=intrinsics)


def _checked(
    thin: Bundle, state: State, test: tuple[Bundle, State], told: Float, free: Bool, k: int
) -> tuple[str, bool]:
    """Return the verdict on the principal point of one camera key, from tracks held out and the shape of its pixels.

    `state` is that of the thinned bundle, `test` the bundle of tracks that are held out, and where its points start.
    """
    noise_px, errors, aspects = thin.noise_px(state), [], []
    for hypothesis in (False, True):
        trial = np.where(np.arange(len(free)) == k, hypothesis, free)
        try:
            found, _ = _decided(thin, told, trial).minimised(_centred(state, thin, trial), noise_px)
        except (np.linalg.LinAlgError, RuntimeError):
            return "held: too few observations to try it", False
        aspects.append(abs(float(found.intrinsics[k, ASPECT])))
        errors.append(_unseen_errors(test[0], replace(found, points=test[1].points), noise_px))
    held, freed = errors
    better = (held - freed)[np.isfinite(held - freed)]
    gain = float(better.sum() / np.nansum(held)) if len(better) else 0.0
    sure = len(better) > 2 and better.mean() > CONFIDENT * better.std(ddof=1) / np.sqrt(len(better))
    if aspects[1] > max(SQUARE, aspects[0]):
        return f"held: free, fx and fy part by {100.0 * aspects[1]:.2f} %, which no sensor's pixels do", False
    if not sure:
        return "held: tracks that were held out agree no better with it", False
    return f"free: the squared error of tracks that were held out falls by {100.0 * gain:.1f} %", True


def _parts(bundle: Bundle) -> tuple[Bool, Bool]:
    """Return which points (N,) make the estimate, thinned for cost, and which are held out."""
    n = int(bundle.point[-1]) + 1
    order = np.random.default_rng(0).permutation(n)
    held_out = order % HELD_OUT == 0
    least = np.bincount(bundle.image[~held_out[bundle.point]]).min()
    share = min(1.0, max(CHECKED_OBSERVATIONS / len(bundle.image), LEAST_PER_IMAGE / max(int(least), 1)))
    return ~held_out & (order < share * n), held_out & (order < max(share, 0.25) * n)


def _of_points(bundle: Bundle, state: State, keep: Bool) -> tuple[Bundle, State]:
    """Return the bundle and state of some of the points."""
    rows = keep[bundle.point]
    _, point = np.unique(bundle.point[rows], return_inverse=True)
    seen = np.zeros(len(state.points), bool)
    seen[bundle.point[rows]] = True
    part = replace(
        bundle,
        image=bundle.image[rows],
        point=point,
        pixel=bundle.pixel[rows],
        weight=bundle.weight[rows],
        ties=None,
    )
    return part, replace(state, points=state.points[seen])


def _unseen_errors(bundle: Bundle, state: State, noise_px: float) -> Float:
    """Return the mean squared error by image (I,) of points that are intersected anew, mismatches clipped."""
    intersected = intersect(bundle, state)
    ratio = np.linalg.norm(bundle.residuals(intersected), axis=1) / noise_px
    clipped = np.minimum(np.where(np.isfinite(ratio), ratio, np.inf), 2.0 * HUBER) ** 2
    count = np.bincount(bundle.image, minlength=len(bundle.keys))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(bundle.image, clipped, len(bundle.keys)) / np.where(count > 0, count, np.nan))


def intersect(bundle: Bundle, state: State) -> State:
    """Return the state with its points intersected anew, cameras as they are; a point that would fail stays."""
    for _ in range(INTERSECTIONS):
        moved = replace(state, points=state.points + bundle.point_step(state, bundle.noise_px(state)))
        behind = np.zeros(len(state.points), bool)
        behind[bundle.point[~np.isfinite(bundle.residuals(moved)).all(axis=1)]] = True
        state = replace(state, points=np.where(behind[:, None], state.points, moved.points))
    return state
