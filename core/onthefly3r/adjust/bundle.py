"""Bundle adjustment of poses, points and shared intrinsics with priors, in vectorised numpy.

Levenberg-Marquardt with the points eliminated (Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis), sparse, so
that it serves the first model and the whole map alike. What is known apart from the images, positions, the level and
ground control, enters as `Ties`. Without them the gauge is free: the damping takes care of it, and the intrinsics do
not depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import rotation_exp
from .intrinsics import PARAMETERS, projection_jacobians, with_intrinsics
from .normal_equations import LEAST_DAMPING, NormalEquations
from .ties import Ties

HUBER = 1.5  # in standard deviations of a pixel coordinate
STUDENT = 4.0  # degrees of freedom of the priors: a lens that is far from usual is believed when the images insist
MAX_ITERATIONS = 40
CONVERGED = 1e-4  # relative decrease of the cost that ends the iterations
FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e9


@dataclass(frozen=True)
class State:
    """The unknowns; a camera key that is held has no intrinsics here."""

    rotations: Float  # (I, 3, 3) local_from_cam
    centres: Float  # (I, 3) local frame
    points: Float  # (N, 3) local frame
    intrinsics: Float  # (K, 8) PARAMETERS of the free keys
    biases: Float = field(default_factory=lambda: np.zeros(0))  # (B,) those of the ties


@dataclass(frozen=True)
class Bundle:
    """Observations sorted by point, at most one of a point in an image, and the priors of the free camera keys."""

    image: Int  # (M,) row of the image
    point: Int  # (M,) row of the point, ascending
    pixel: Float  # (M, 2)
    weight: Float  # (M,) information relative to an independent observation
    keys: tuple[str, ...]  # (I,) camera key of each image
    free: tuple[str, ...]  # (K,) camera keys whose intrinsics are estimated
    cameras: Mapping[str, Camera]  # by key; of a free key only the size is used
    mean: Float  # (K, 8)
    whitening: Float  # (K, 8, 8)
    adjustable: Bool  # (8,) or (K, 8) which of PARAMETERS may change
    ties: Ties | None = None
    spread: Float | float = 1.0  # (M,) standard deviation relative to that of a tie point
    prior_weight: Float | float = 1.0  # (K, 8) of the deviations from the priors

    def camera(self, key: str, state: State) -> Camera:
        """Return the camera of a key in this state."""
        if key not in self.free:
            return self.cameras[key]
        return with_intrinsics(self.cameras[key], state.intrinsics[self.free.index(key)])

    def residuals(self, state: State) -> Float:
        """Return observed minus projected pixels (M, 2); NaN behind a camera."""
        seen = self._in_camera(state)
        projected = np.empty_like(self.pixel)
        for key in set(self.keys):
            rows = self._rows(key)
            projected[rows] = self.camera(key, state).project(seen[rows])
        return self.pixel - projected

    def noise_px(self, state: State) -> float:
        """Return the standard deviation of a pixel coordinate, from the median residual and the redundancy."""
        squared = np.sum(self.residuals(state) ** 2, axis=1) / np.square(self.spread)
        squared = squared[np.isfinite(squared)]
        unknowns = 3 * len(state.points) + 6 * len(self.keys)
        redundancy = max(1.0 - unknowns / (2.0 * len(squared)), 0.05)
        return float(max(np.sqrt(np.median(squared) / (2.0 * np.log(2.0)) / redundancy), 1e-6))  # Rayleigh's median

    def cost(self, state: State, noise_px: float) -> float:
        """Return half the weighted Huber cost, priors and ties added; infinite with a point behind its camera."""
        ratio = np.linalg.norm(self.residuals(state), axis=1) / (noise_px * self.spread)
        if not np.isfinite(ratio).all():
            return np.inf
        huber = np.where(ratio <= HUBER, 0.5 * ratio**2, HUBER * (ratio - 0.5 * HUBER))
        prior = self.prior_weight * 0.5 * STUDENT * np.log1p(self.deviation(state) ** 2 / STUDENT)
        tied = self.ties.cost(state.rotations, state.centres, state.points, state.biases) if self.ties else 0.0
        return float(self.weight @ huber + prior.sum() + tied)

    def deviation(self, state: State) -> Float:
        """Return the intrinsics minus the prior mean (K, 8), in standard deviations of the priors."""
        return np.asarray(np.einsum("kij,kj->ki", self.whitening, state.intrinsics - self.mean))

    def normal_equations(self, state: State, noise_px: float) -> NormalEquations:
        """Return the normal equations of the reweighted residuals, priors and ties."""
        residual = self.residuals(state)
        ratio = np.linalg.norm(residual, axis=1) / (noise_px * self.spread)
        root = np.sqrt(self.weight * np.minimum(1.0, HUBER / np.maximum(ratio, 1e-12))) / (noise_px * self.spread)
        residual = root[:, None] * residual
        by_pose, by_intrinsics, by_point = (root[:, None, None] * jacobian for jacobian in self.jacobians(state))
        cc, c = self._poses_and_shared(state, by_pose, by_intrinsics, residual)
        point_t, intrinsics_t = np.swapaxes(by_point, 1, 2), np.swapaxes(by_intrinsics, 1, 2)
        n = len(state.points)
        pp = self._by_point(point_t @ by_point, n)
        p = self._by_point(np.einsum("mki,mk->mi", by_point, residual), n)
        if self.ties:
            tied_pp, tied_p = self.ties.points(state.points)
            pp[self.ties.control], p[self.ties.control] = pp[self.ties.control] + tied_pp, p[self.ties.control] + tied_p
        shared = np.zeros((c.size - 6 * len(self.keys), n, 3))
        for k, key in enumerate(self.free):
            crossed = self._by_point(intrinsics_t @ by_point * self._rows(key)[:, None, None], n)
            shared[k * len(PARAMETERS) : (k + 1) * len(PARAMETERS)] = np.swapaxes(crossed, 0, 1)
        return NormalEquations(
            cc=cc,
            pp=pp,
            pose_point=np.swapaxes(by_pose, 1, 2) @ by_point,
            shared_point=shared,
            c=c,
            p=p,
            image=self.image,
            point=self.point,
        )

    def jacobians(self, state: State) -> tuple[Float, Float, Float]:
        """Return d pixel / d (rotation, centre) (M, 2, 6), d intrinsics (M, 2, 8) and d point (M, 2, 3).

        A rotation is perturbed on the camera's side, R exp(w); intrinsics that are held have zeros.
        """
        seen = self._in_camera(state)
        by_seen, by_intrinsics = np.empty((len(seen), 2, 3)), np.zeros((len(seen), 2, len(PARAMETERS)))
        adjustable = np.broadcast_to(self.adjustable, (len(self.free), len(PARAMETERS)))
        for key in set(self.keys):
            rows = self._rows(key)
            by_seen[rows], derivative = projection_jacobians(self.camera(key, state), seen[rows])
            if key in self.free:
                by_intrinsics[rows] = derivative * adjustable[self.free.index(key)]
        by_point = by_seen @ np.swapaxes(state.rotations, 1, 2)[self.image]
        by_rotation = np.cross(by_seen, seen[:, None, :])  # the point moves by seen x w
        return np.concatenate([by_rotation, -by_point], axis=2), by_intrinsics, by_point

    def moved(self, state: State, dc: Float, dp: Float) -> State:
        """Return the state after a step of poses and shared unknowns (D,) and points (N, 3)."""
        poses, shared = dc[: 6 * len(self.keys)].reshape(-1, 6), dc[6 * len(self.keys) :]
        turned = np.array([r @ rotation_exp(w) for r, w in zip(state.rotations, poses[:, :3], strict=True)])
        intrinsics = state.intrinsics + shared[: state.intrinsics.size].reshape(state.intrinsics.shape)
        biases = state.biases + shared[state.intrinsics.size :]
        return State(turned, state.centres + poses[:, 3:], state.points + dp, intrinsics, biases)

    def point_step(self, state: State, noise_px: float) -> Float:
        """Return the step (N, 3) of the points alone, cameras as they are."""
        residual = self.residuals(state)
        ratio = np.linalg.norm(residual, axis=1) / noise_px
        weight = self.weight * np.minimum(1.0, HUBER / np.maximum(np.nan_to_num(ratio, nan=np.inf), 1e-12))
        seen = self._in_camera(state)
        by_seen = np.empty((len(seen), 2, 3))
        for key in set(self.keys):
            rows = self._rows(key)
            by_seen[rows], _ = projection_jacobians(self.camera(key, state), seen[rows])
        by_point = by_seen @ np.swapaxes(state.rotations, 1, 2)[self.image]
        n = len(state.points)
        pp = self._by_point(weight[:, None, None] * (np.swapaxes(by_point, 1, 2) @ by_point), n)
        p = self._by_point(np.einsum("mki,m,mk->mi", by_point, weight, np.nan_to_num(residual)), n)
        trace = np.einsum("nii->n", pp)
        return np.linalg.solve(pp + (LEAST_DAMPING * trace + (trace == 0.0))[:, None, None] * np.eye(3), p[:, :, None])[
            ..., 0
        ]

    def minimised(self, state: State, noise_px: float, most: int = MAX_ITERATIONS) -> tuple[State, int]:
        """Return the state of least cost near this one, and the number of iterations."""
        cost, damping = self.cost(state, noise_px), FIRST_DAMPING
        for iteration in range(1, most + 1):
            normal = self.normal_equations(state, noise_px)
            trial = self.moved(state, *normal.step(damping))
            while not (trial_cost := self.cost(trial, noise_px)) <= cost:
                damping *= 10.0
                if damping > MOST_DAMPING:
                    return state, iteration
                trial = self.moved(state, *normal.step(damping))
            decrease = cost - trial_cost
            state, cost, damping = trial, trial_cost, max(damping / 10.0, LEAST_DAMPING)
            if decrease <= CONVERGED * cost:
                break
        return state, iteration

    def _in_camera(self, state: State) -> Float:
        offset = state.points[self.point] - state.centres[self.image]
        return np.asarray(np.einsum("mji,mj->mi", state.rotations[self.image], offset))

    def _rows(self, key: str) -> Bool:
        return np.asarray(np.array(self.keys) == key)[self.image]

    def _by_point(self, values: Float, n: int) -> Float:
        starts = np.flatnonzero(np.diff(self.point, prepend=-1))
        total = np.zeros((n, *values.shape[1:]))
        total[self.point[starts]] = np.add.reduceat(values, starts)
        return total

    def _poses_and_shared(
        self, state: State, by_pose: Float, by_intrinsics: Float, residual: Float
    ) -> tuple[Any, Float]:
        """Return the sparse matrix (D, D) and the right side (D,) of the poses and shared unknowns."""
        from scipy import sparse

        n_images, size = len(self.keys), len(PARAMETERS)
        n_lens, n_biases = size * len(self.free), len(state.biases)
        pose_t, intrinsics_t = np.swapaxes(by_pose, 1, 2), np.swapaxes(by_intrinsics, 1, 2)
        poses, right = self._by_image(pose_t @ by_pose), self._by_image(np.einsum("mki,mk->mi", by_pose, residual))
        mixed = np.zeros((n_images, 6, n_lens + n_biases))
        shared, shared_right = np.zeros((n_lens + n_biases,) * 2), np.zeros(n_lens + n_biases)
        crossed, squared = self._by_image(pose_t @ by_intrinsics), self._by_image(intrinsics_t @ by_intrinsics)
        gradient = self._by_image(np.einsum("mki,mk->mi", by_intrinsics, residual))
        deviation = self.deviation(state)
        prior_weight = self.prior_weight / (1.0 + deviation**2 / STUDENT)
        for k, key in enumerate(self.free):
            own, lens = np.flatnonzero(np.array(self.keys) == key), slice(k * size, (k + 1) * size)
            mixed[own, :, lens] = crossed[own]
            prior = self.whitening[k].T * prior_weight[k]
            shared[lens, lens] = squared[own].sum(axis=0) + prior @ self.whitening[k]
            shared_right[lens] = gradient[own].sum(axis=0) - prior @ deviation[k]
        if self.ties:
            tied = self.ties.cameras(state.rotations, state.centres, state.biases)
            poses, right = poses + tied.poses, right + tied.poses_right
            mixed[:, :, n_lens:] = tied.mixed
            shared[n_lens:, n_lens:], shared_right[n_lens:] = tied.biases, tied.biases_right
        both = np.append(right, shared_right)
        if n_lens + n_biases == 0:
            return sparse.block_diag(poses).tocsr(), both
        across = sparse.csr_matrix(mixed.reshape(6 * n_images, -1))
        return sparse.bmat([[sparse.block_diag(poses), across], [across.T, shared]], format="csr"), both

    def _by_image(self, values: Float) -> Float:
        order = np.argsort(self.image, kind="stable")
        rows = self.image[order]
        starts = np.flatnonzero(np.diff(rows, prepend=-1))
        total = np.zeros((len(self.keys), *values.shape[1:]))
        total[rows[starts]] = np.add.reduceat(values[order], starts)
        return total
