"""One gain per photograph and channel, so that photographs agree where they overlap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float, Int

ROUNDS = 8  # of reweighting
NO_CHANGE = 0.02  # weight of a gain of 1, per sample
DARK, BURNT = 12.0, 243.0  # grey levels that tell nothing
MAX_GAIN = 2.0


@dataclass(frozen=True)
class ColourSamples:
    """Colours of the same surface points in several photographs."""

    photograph: Int  # (M,) shot index
    point: Int  # (M,) number of the surface point
    rgb: Float  # (M, 3) grey levels, smoothed


def gains(samples: ColourSamples) -> dict[int, Float]:
    """Return the factors (3,) that bring each photograph to the common colour, near 1 on the whole.

    With log c = a(point) - g(photograph), least squares over all samples, reweighted for what differs for other
    reasons (shine, moving things); the points are eliminated, so that the system has one unknown a photograph.
    """
    usable = ((samples.rgb > DARK) & (samples.rgb < BURNT)).all(axis=1)
    numbers, photograph = np.unique(samples.photograph[usable], return_inverse=True)
    _, point = np.unique(samples.point[usable], return_inverse=True)
    if not len(numbers):
        return {}
    logs = np.log(samples.rgb[usable])
    found = np.stack([_channel(photograph, point, logs[:, k], len(numbers)) for k in range(3)], axis=1)
    factors = np.exp(np.clip(found, -np.log(MAX_GAIN), np.log(MAX_GAIN)))
    return {int(number): factors[k] for k, number in enumerate(numbers)}


def spread(samples: ColourSamples, factors: Mapping[int, Float]) -> float:
    """Return the median relative difference of a photograph's colour from the mean of its points, with the gains."""
    logs = np.log(np.clip(samples.rgb, 1.0, None)) + np.log(
        np.array([factors.get(int(k), np.ones(3)) for k in samples.photograph]).reshape(-1, 3)
    )
    _, point, count = np.unique(samples.point, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(point, logs[:, k]) for k in range(3)], axis=1) / count[:, None]
    several = count[point] > 1
    return float(np.median(np.abs(logs - mean[point])[several])) if several.any() else 0.0


def sharpness_lack(sharpness: Mapping[int, float]) -> dict[int, float]:
    """Return how much less sharp each photograph is than the median one, natural logarithm, never negative."""
    usual = float(np.median(list(sharpness.values()))) if sharpness else 1.0
    return {k: max(0.0, float(np.log(usual / max(value, 1e-6)))) for k, value in sharpness.items()}


def joined(parts: Sequence[ColourSamples]) -> ColourSamples:
    """Return all samples in one."""
    if not parts:
        return ColourSamples(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))
    return ColourSamples(
        np.concatenate([p.photograph for p in parts]),
        np.concatenate([p.point for p in parts]),
        np.concatenate([p.rgb for p in parts]),
    )


def _channel(photograph: Int, point: Int, logs: Float, count: int) -> Float:
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import spsolve

    weight, gain = np.ones(len(logs)), np.zeros(count)
    points = int(point.max()) + 1
    for _ in range(ROUNDS):
        of_point = np.bincount(point, weight, points)
        seen = coo_matrix((weight, (photograph, point)), (count, points)).tocsr()
        # Normal equations without the points' unknowns (Schur complement).
        system = diags(np.asarray(seen.sum(axis=1)).ravel()) - seen @ diags(1.0 / of_point) @ seen.T
        mean = np.bincount(point, weight * logs, points) / of_point
        right = -(np.bincount(photograph, weight * logs, count) - seen @ mean)
        pull = NO_CHANGE * np.bincount(photograph, minlength=count)
        gain = np.atleast_1d(spsolve((system + diags(pull)).tocsc(), right))
        left = logs + gain[photograph]
        mean = np.bincount(point, weight * left, points) / of_point
        left = left - mean[point]
        sigma = max(1.4826 * float(np.median(np.abs(left))), 1e-4)
        weight = 1.0 / (1.0 + (left / (2.0 * sigma)) ** 2)
    return np.asarray(gain)
