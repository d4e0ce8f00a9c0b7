"""Similarity from camera centres to positions that believes heights only as far as they deserve.

One maximum a posteriori estimate of rotation, scale, shift, a linear trend of the height errors and a height bias
per flight. The trend is as large as the residuals suggest (heavy tails), so a survey is tilted to follow its heights
only where the positions are precise; witnesses of the up direction enter as rows of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float
from ..geometry.transforms import Sim3, nearest_rotation, rotation_exp, skew
from .fitstart import free_start, level_start
from .positions import Positions
from .updirection import UpWitness, cauchy_cost, cauchy_weight, squared_misfit

TUKEY = 4.685  # 95 % efficient
OUTLIER_SIGMAS = 4.0
MIN_NOISE = 0.1  # of the stated sigmas: consumer receivers stated at 3 m repeat to 0.3 m at best
MAX_CORRELATION = 0.98
MAX_INDEPENDENT = 20.0  # the map's own bending does not average out, however many positions there are
TREND_CORE = 4.0  # squared sigmas beyond which height drift is an accident and no longer noise


@dataclass(frozen=True)
class LevelFit:
    """The fit, per position in the order of `Positions.images`."""

    enu_from_map: Sim3
    residuals: Float  # (N, 3) position minus camera, ENU, m; height 0 where there is none
    inlier_h: Bool  # (N,)
    inlier_v: Bool  # (N,) False where there is no height
    sigma_h_m: float  # robust scatter per horizontal axis
    sigma_v_m: float
    trend: Float  # (2,) height errors per metre east and north
    position_tilt_sigma: Float  # (2,) rad, of the level that positions alone give: best and worst direction
    shares: tuple[tuple[str, float], ...]  # who decided the up direction, fractions of the information
    cost: float


def fit(centres: Float, positions: Positions, first_up: Float, witnesses: Sequence[UpWitness], seed: int) -> LevelFit:
    """Return the best fit of camera centres (N, 3) in the map frame to positions.

    Starts from the witnesses' up direction and from the positions alone, and keeps the more probable end.
    """
    random = np.random.default_rng(seed)
    starts = [level_start(centres, positions, first_up, random)]
    free = free_start(centres, positions, random)
    if free is not None:
        starts.append(free)
    solvers = [_Solver(centres, positions, witnesses, start) for start in starts]
    for solver in solvers:
        solver.solve()
    # One noise level for all hypotheses, else a bad fit would excuse itself by large sigmas.
    noise = min(s.noise_h for s in solvers), min(s.noise_v for s in solvers), max(s.independence for s in solvers)
    # The witnesses' rows cannot tell up from down: an end that hangs upside down does not count.
    upright = [s for s in solvers if float(s.transform.rotation[2] @ first_up) > 0.0] or solvers[:1]
    return min((solver.result(noise) for solver in upright), key=lambda result: result.cost)


class _Solver:
    """Iteratively reweighted Gauss-Newton; unknowns [rotation 3, log scale, shift 3, trend 2, bias per flight]."""

    def __init__(self, centres: Float, positions: Positions, witnesses: Sequence[UpWitness], start: Sim3) -> None:
        self.centres, self.positions, self.witnesses = centres, positions, witnesses
        self.transform = start
        self.trend = np.zeros(2)
        self.flights = int(positions.flight.max()) + 1
        self.bias = np.zeros(self.flights)
        self.noise_h = self.noise_v = 1.0  # factors on the stated sigmas
        self.independence = 1.0  # share of the positions that count once their errors' correlation is seen
        self.middle = np.median(start.apply(centres), axis=0)

    def solve(self) -> None:
        for step in range(60):
            if step < 30:  # later the scale stays, so that the iteration settles
                self._update_noise()
            hessian, gradient = self._normal_equations()
            delta = np.linalg.solve(hessian, gradient)
            length = float(np.linalg.norm(delta[:3]))
            delta = delta * min(1.0, 0.3 / max(length, 1e-12))
            self._apply(delta)
            if step >= 30 and length < 1e-9:
                break

    def result(self, noise: tuple[float, float, float]) -> LevelFit:
        p, residuals = self.positions, self._residuals(nuisance=False)
        clean = self._residuals(nuisance=True)
        inlier_h = np.hypot(clean[:, 0], clean[:, 1]) < OUTLIER_SIGMAS * self.noise_h * p.sigma_h_m
        inlier_v = (np.abs(clean[:, 2]) < OUTLIER_SIGMAS * self.noise_v * p.sigma_v_m) & p.has_height
        tilt_sigma, shares = self._who_decided()
        return LevelFit(
            enu_from_map=self.transform,
            residuals=residuals * np.column_stack([np.ones((len(p.enu), 2)), p.has_height]),
            inlier_h=inlier_h,
            inlier_v=inlier_v,
            sigma_h_m=float(self.noise_h * np.median(p.sigma_h_m)),
            sigma_v_m=float(self.noise_v * np.median(p.sigma_v_m)),
            trend=self.trend,
            position_tilt_sigma=tilt_sigma,
            shares=shares,
            cost=self._cost(noise),
        )

    def _residuals(self, nuisance: bool) -> Float:
        predicted = self.transform.apply(self.centres)
        residuals = self.positions.enu - predicted
        if nuisance:
            residuals[:, 2] -= (predicted - self.middle)[:, :2] @ self.trend + self.bias[self.positions.flight]
        return np.asarray(residuals)

    def _update_noise(self) -> None:
        """Robust scale of the residuals over the stated sigmas; few positions cannot prove to be far better."""
        p, residuals = self.positions, self._residuals(nuisance=True)
        n = len(p.enu)
        freedom = np.sqrt(n / max(n - 3.5, 1.0))
        # Median of a Rayleigh variable is 1.177 sigma, of a half-normal one 0.674 sigma.
        horizontal = float(np.median(np.hypot(residuals[:, 0], residuals[:, 1]) / p.sigma_h_m)) / 1.1774
        self.noise_h = max(horizontal * freedom, 1.0 / n, MIN_NOISE)
        if p.has_height.any():
            vertical = float(np.median((np.abs(residuals[:, 2]) / p.sigma_v_m)[p.has_height])) / 0.6745
            self.noise_v = max(vertical * freedom, 1.0 / n, MIN_NOISE)

        # First-order autoregressive errors: N (1 - rho) / (1 + rho) of N positions are independent.
        ratio = np.clip(residuals / self._sigmas(), -OUTLIER_SIGMAS, OUTLIER_SIGMAS)[p.order]
        ratio = ratio - ratio.mean(axis=0)
        lagged, power = float((ratio[1:] * ratio[:-1]).sum()), float((ratio**2).sum())
        correlation = min(max(lagged / max(power, 1e-12), 0.0), MAX_CORRELATION)
        share = min((1.0 - correlation) / (1.0 + correlation), MAX_INDEPENDENT / n)
        self.independence = max(share, min(1.0, 2.0 / n))

    def _sigmas(self) -> Float:
        p = self.positions
        horizontal = self.noise_h * p.sigma_h_m
        return np.stack([horizontal, horizontal, self.noise_v * p.sigma_v_m], axis=-1)

    def _trend_sigma(self) -> float:
        """Expected height trend (m per m): one robust scatter over the extent of the survey."""
        p = self.positions
        scatter = max(self.noise_h * float(np.median(p.sigma_h_m)), self.noise_v * float(np.median(p.sigma_v_m)))
        spread = self.transform.apply(self.centres)[:, :2] - self.middle[:2]
        extent = 1.4826 * float(np.median(np.linalg.norm(spread, axis=1))) / 1.1774
        return scatter / max(extent, 1e-6)

    def _normal_equations(self, with_witnesses: bool = True) -> tuple[Float, Float]:
        p = self.positions
        predicted = self.transform.apply(self.centres)
        arm = predicted - self.middle
        residuals = self._residuals(nuisance=True)
        n, unknowns = len(arm), 9 + self.flights
        jacobian = np.zeros((n, 3, unknowns))
        jacobian[:, :, :3] = -np.array([skew(a) for a in arm])
        jacobian[:, :, 3] = arm
        jacobian[:, :, 4:7] = np.eye(3)
        jacobian[:, 2, 7:9] = arm[:, :2]
        jacobian[np.arange(n), 2, 9 + p.flight] = 1.0
        weight = self._weights(residuals)
        hessian = np.einsum("nkp,nk,nkq->pq", jacobian, weight, jacobian)
        gradient = np.einsum("nkp,nk,nk->p", jacobian, weight, residuals)
        sigma = self._trend_sigma()
        trend_weight = cauchy_weight(float(self.trend @ self.trend) / sigma**2, TREND_CORE) / sigma**2
        hessian[[7, 8], [7, 8]] += trend_weight
        gradient[7:9] -= trend_weight * self.trend
        bias_weight = 1.0 / max(float(np.median(p.sigma_v_m)), 1e-3) ** 2 if self.flights > 1 else 1e12
        diagonal = np.arange(9, unknowns)
        hessian[diagonal, diagonal] += bias_weight
        gradient[9:] -= bias_weight * self.bias
        if with_witnesses:
            for witness in self.witnesses:
                rows, misfit = self._witness_rows(witness)
                hessian[:3, :3] += rows.T @ rows
                gradient[:3] -= rows.T @ misfit
        hessian[np.arange(7), np.arange(7)] += 1e-9  # what no one observes stays where it started
        return hessian, gradient

    def _witness_rows(self, witness: UpWitness) -> tuple[Float, Float]:
        """Rows and misfits of d . up: with e = R d in ENU it is e_z, which a turn w changes by w_x e_y - w_y e_x."""
        weight = np.sqrt(cauchy_weight(squared_misfit(witness, self.transform.rotation[2])))
        enu = witness.directions @ self.transform.rotation.T
        rows = np.stack([enu[:, 1], -enu[:, 0], np.zeros(len(enu))], axis=-1)
        return rows * (weight / witness.sigma)[:, None], enu[:, 2] * weight / witness.sigma

    def _weights(self, residuals: Float) -> Float:
        """Tukey's biweight over squared sigmas, horizontal and vertical on their own (N, 3)."""
        sigmas = self._sigmas()
        horizontal = _tukey(np.hypot(residuals[:, 0], residuals[:, 1]) / sigmas[:, 0])
        vertical = _tukey(residuals[:, 2] / sigmas[:, 2]) * self.positions.has_height
        return self.independence * np.stack([horizontal, horizontal, vertical], axis=-1) / sigmas**2

    def _apply(self, delta: Float) -> None:
        turn, growth = rotation_exp(delta[:3]), float(np.exp(np.clip(delta[3], -0.5, 0.5)))
        t = self.transform
        translation = growth * (turn @ (t.translation - self.middle)) + self.middle + delta[4:7]
        self.transform = Sim3(t.scale * growth, nearest_rotation(turn @ t.rotation), translation)
        self.trend = self.trend + delta[7:9]
        self.bias = self.bias + delta[9:]

    def _cost(self, noise: tuple[float, float, float]) -> float:
        p, residuals = self.positions, self._residuals(nuisance=True)
        horizontal = _tukey_cost(np.hypot(residuals[:, 0], residuals[:, 1]) / (noise[0] * p.sigma_h_m))
        vertical = _tukey_cost(residuals[:, 2] / (noise[1] * p.sigma_v_m)) * p.has_height
        cost = noise[2] * float(horizontal.sum() + vertical.sum())
        cost += sum(cauchy_cost(squared_misfit(witness, self.transform.rotation[2])) for witness in self.witnesses)
        return cost + cauchy_cost(float(self.trend @ self.trend) / self._trend_sigma() ** 2, TREND_CORE)

    def _who_decided(self) -> tuple[Float, tuple[tuple[str, float], ...]]:
        """Return the tilt sigmas of positions alone, and each source's share of the tilt information."""
        hessian, _ = self._normal_equations(with_witnesses=False)
        rest = np.arange(2, len(hessian))
        cross = hessian[:2, rest]
        information = hessian[:2, :2] - cross @ np.linalg.solve(hessian[np.ix_(rest, rest)], cross.T)
        sources = [("positions", information)]
        for witness in self.witnesses:
            rows = self._witness_rows(witness)[0][:, :2]
            sources.append((witness.name, rows.T @ rows))
        total = np.linalg.inv(sum((s for _, s in sources), 1e-9 * np.eye(2)))
        shares = tuple((name, 0.5 * float(np.trace(total @ source))) for name, source in sources)
        return 1.0 / np.sqrt(np.maximum(np.linalg.eigvalsh(information)[::-1], 1e-12)), shares


def _tukey(ratio: Float) -> Float:
    return np.asarray(np.where(np.abs(ratio) < TUKEY, (1.0 - (ratio / TUKEY) ** 2) ** 2, 0.0))


def _tukey_cost(ratio: Float) -> Float:
    inside = 1.0 - np.minimum(1.0, (ratio / TUKEY) ** 2)
    return np.asarray(TUKEY**2 / 6.0 * (1.0 - inside**3))
