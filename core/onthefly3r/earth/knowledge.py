"""What positions, gimbal angles and control say of a block, as ties of its bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..adjust.ties import LEVER, Ties
from ..geometry.arrays import Bool, Float
from .levelfit import LevelFit
from .positions import Positions
from .updirection import UpWitness, cauchy_weight, fuse, squared_misfit

FLIGHT_BIAS_M = 15.0  # heights of one flight against another
CONTROL_BIAS_M = (10.0, 10.0, 100.0)  # positions against control: datum, receiver, vertical reference
LEVER_M = 0.3  # antenna from camera
PRECISE_M = 0.15  # positions that are so good can tell the lever arm
MOST_CORRELATED = 0.98
FAR_SIGMAS = 5.0  # beyond which an error says nothing of how errors follow one another


def block_ties(
    images: Sequence[int],
    rotations: Float,
    positions: Positions | None,
    fitted: LevelFit | None,
    witnesses: Sequence[UpWitness],
    map_up: Float | None,
    control_m: Float,
    control_sigma_m: Float,
    first_control: int,
) -> Ties:
    """Return the ties of a block in local east-north-up.

    Args:
        images: shot index of every row of the bundle.
        rotations: (I, 3, 3) map_from_cam of the rows.
        positions, fitted: positions and the robust similarity to them; None without.
        witnesses, map_up: of the upward direction, in the map; none where control tells the level.
        control_m, control_sigma_m: (K, 3) control points, whose rows in the bundle begin at `first_control`.
    """
    n, n_control = len(images), len(control_m)
    position, sigma = np.zeros((n, 3)), np.full((n, 3), np.inf)
    flight = np.zeros(n, int)
    if positions is not None and fitted is not None:
        row_of = {index: row for row, index in enumerate(images)}
        known = [k for k, index in enumerate(positions.images) if index in row_of]
        rows = [row_of[positions.images[k]] for k in known]
        position[rows], sigma[rows] = positions.enu[known], position_sigmas(positions, fitted)[known]
        flight[rows] = positions.flight[known]
    flights = int(flight.max(initial=0)) + 1
    bias = np.zeros((flights, 3))
    if n_control:
        bias[:] = CONTROL_BIAS_M
    elif flights > 1:
        bias[:, 2] = FLIGHT_BIAS_M
    precise = bool(np.isfinite(sigma).any()) and float(np.median(sigma[np.isfinite(sigma)])) < PRECISE_M
    up, level_root = _level(rotations, witnesses if n_control < 3 else (), map_up, fitted)
    return Ties(
        position=position,
        sigma=sigma,
        flight=flight,
        bias_sigma=np.append(bias.ravel(), np.full(LEVER, LEVER_M if precise else 0.0)),
        up=up,
        level_root=level_root,
        control=first_control + np.arange(n_control),
        control_m=control_m,
        control_sigma_m=control_sigma_m,
    )


def position_sigmas(positions: Positions, fitted: LevelFit) -> Float:
    """Return the standard deviations (N, 3) of positions as they scatter, errors that follow one another counted once.

    Outliers and missing heights have infinite ones. Heights that drift are as bad as they drift.
    """
    off = fitted.residuals.copy()
    for number in range(int(positions.flight.max(initial=0)) + 1):
        own = (positions.flight == number) & fitted.inlier_v
        if own.any():
            off[positions.flight == number, 2] -= np.median(off[own, 2])
    horizontal = positions.sigma_h_m * fitted.sigma_h_m / np.median(positions.sigma_h_m)
    vertical = positions.sigma_v_m * fitted.sigma_v_m / np.median(positions.sigma_v_m)
    if fitted.inlier_v.any():
        drift = 1.4826 * float(np.median(np.abs(off[fitted.inlier_v, 2] / vertical[fitted.inlier_v])))
        vertical = vertical * max(1.0, drift)
    sigma = np.stack([horizontal, horizontal, vertical], axis=1)
    sigma[:, :2] /= np.sqrt(_independent_share(off[:, :2] / sigma[:, :2], fitted.inlier_h, positions))
    sigma[:, 2] /= np.sqrt(_independent_share(off[:, 2:] / sigma[:, 2:], fitted.inlier_v, positions))
    sigma[~fitted.inlier_h] = np.inf
    sigma[~fitted.inlier_v, 2] = np.inf
    return np.asarray(sigma)


def _independent_share(ratio: Float, inlier: Bool, positions: Positions) -> float:
    """Return which share of errors (N, k) counts: (1 - rho) / (1 + rho) of a first-order autoregression."""
    in_order = np.clip(ratio, -FAR_SIGMAS, FAR_SIGMAS)[positions.order][inlier[positions.order]]
    if len(in_order) < 10:
        return 1.0
    power = float((in_order**2).sum())
    correlation = float((in_order[1:] * in_order[:-1]).sum()) / max(power, 1e-12)
    noise = 2.0 / np.sqrt(in_order.size)  # what chance makes of errors that do not follow one another
    correlation = min(correlation, MOST_CORRELATED) if correlation > noise else 0.0
    return (1.0 - correlation) / (1.0 + correlation)


def _level(
    rotations: Float, witnesses: Sequence[UpWitness], map_up: Float | None, fitted: LevelFit | None
) -> tuple[Float, Float]:
    """Return the upward direction in every camera (I, 3), and the root of its information (I, 2, 2), shared by all."""
    n = len(rotations)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    if not witnesses or map_up is None or fitted is None:
        return up, np.zeros((n, 2, 2))
    best = fuse(witnesses, map_up)
    information = 1e-12 * np.eye(2)
    for witness in witnesses:
        enu = (witness.directions @ fitted.enu_from_map.rotation.T)[:, :2] / witness.sigma[:, None]
        weight = cauchy_weight(squared_misfit(witness, fitted.enu_from_map.rotation[2]))
        information = information + weight * enu.T @ enu
    root = np.linalg.cholesky(information / n).T
    return rotations.transpose(0, 2, 1) @ best, np.tile(root, (n, 1, 1))
