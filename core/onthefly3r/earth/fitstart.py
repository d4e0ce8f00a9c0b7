"""First similarities from camera centres to positions, by least median of squares: half the positions may be wrong.

P. J. Rousseeuw, "Least median of squares regression", JASA 79(388), 1984.
"""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Sim3, nearest_rotation, skew
from ..geometry.umeyama import weighted_similarity
from .positions import Positions

SAMPLES = 600  # with half the positions wrong, 600 pairs hold about 150 good ones


def level_start(centres: Float, positions: Positions, up: Float, random: np.random.Generator) -> Sim3:
    """Return the least-median-of-squares plane similarity with a given up direction; heights by their median."""
    level = _level_rotation(up)
    flat = centres @ level.T
    source, target = flat[:, 0] + 1j * flat[:, 1], positions.enu[:, 0] + 1j * positions.enu[:, 1]
    first, second = random.integers(0, len(centres), (2, SAMPLES))
    span = np.abs(source[first] - source[second])
    good = span > 0.1 * np.median(np.abs(source - np.median(source.real) - 1j * np.median(source.imag)))
    first, second = first[good], second[good]
    turn = (target[first] - target[second]) / (source[first] - source[second])
    turn = turn[np.abs(turn) > 1e-12]
    best, best_score = (1.0 + 0.0j, 0.0 + 0.0j), np.inf
    for candidate in turn:
        offsets = target - candidate * source
        shift = np.median(offsets.real) + 1j * np.median(offsets.imag)
        score = float(np.median(np.abs(offsets - shift) / positions.sigma_h_m))
        if score < best_score:
            best, best_score = (candidate, shift), score
    (turn_best, shift_best), scale = best, abs(best[0])
    yaw = np.array([[turn_best.real, -turn_best.imag, 0.0], [turn_best.imag, turn_best.real, 0.0], [0.0, 0.0, scale]])
    seen = positions.has_height if positions.has_height.any() else np.ones(len(centres), bool)
    lift = float(np.median((positions.enu[:, 2] - scale * flat[:, 2])[seen]))
    return Sim3(scale, nearest_rotation(yaw / scale @ level), np.array([shift_best.real, shift_best.imag, lift]))


def free_start(centres: Float, positions: Positions, random: np.random.Generator) -> Sim3 | None:
    """Return the least-median-of-squares similarity of position triples; None when no triple determines one."""
    seen = np.flatnonzero(positions.has_height)
    if len(seen) < 4:
        return None
    best, best_score = None, np.inf
    for _ in range(SAMPLES // 2):
        triple = random.choice(seen, 3, replace=False)
        try:
            candidate = weighted_similarity(centres[triple], positions.enu[triple], np.ones(3))
        except ValueError:
            continue
        if not candidate.scale > 1e-9:
            continue
        residual = (positions.enu - candidate.apply(centres))[seen]
        score = float(
            np.median(
                np.hypot(
                    np.hypot(residual[:, 0], residual[:, 1]) / positions.sigma_h_m[seen],
                    residual[:, 2] / positions.sigma_v_m[seen],
                )
            )
        )
        if score < best_score:
            best, best_score = candidate, score
    return best


def _level_rotation(up: Float) -> Float:
    """Return any rotation that turns `up` into the z axis."""
    least = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = skew(up) @ least
    x = x / float(np.linalg.norm(x))
    return np.stack([x, skew(up) @ x, up])
