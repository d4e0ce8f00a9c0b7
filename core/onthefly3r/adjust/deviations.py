"""Standard deviations of cameras from the normal equations of an adjustment."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.arrays import Float
from .normal_equations import NormalEquations

EXACT_UNKNOWNS = 2500  # up to so many all columns are solved for; beyond, deviations are sampled
SAMPLES = 100  # to 1 / sqrt(2 * 100) = 7 %


def camera_deviations(normal: NormalEquations, seed: int = 0) -> Float:
    """Return the standard deviations (I, 6) of rotation vectors (rad, camera axes) and centres (units of the block).

    Everything else is marginalised. Of large blocks they are those of samples drawn from the posterior.
    """
    n = normal.n_poses
    if len(normal.c) <= EXACT_UNKNOWNS:
        variance = np.diag(normal.covariance_of(np.arange(n)))
    else:
        variance = np.var(normal.samples(SAMPLES, seed)[:n], axis=1)
    return np.sqrt(np.maximum(variance, 0.0)).reshape(-1, 6)


def propagated(normal: NormalEquations, solver: Any, jacobian: Float) -> Float:
    """Return the covariance (k, k) of quantities whose derivatives by the unknowns of C are (k, D)."""
    return np.asarray(jacobian @ solver(np.ascontiguousarray(jacobian.T)))
