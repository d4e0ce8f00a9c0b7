"""Bundle adjustment of poses, points and shared intrinsics with priors on the intrinsics, in vectorised numpy.

Levenberg-Marquardt with the points eliminated (Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis), sparse, so
that it serves the first model and the whole map alike. The gauge is left free: the damping takes care of it, and the
intrinsics do not depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import rotation_exp
from .intrinsics import PARAMETERS, projection_jacobians, with_intrinsics

HUBER = 1.5  # in standard deviations of a pixel coordinate
STUDENT = 4.0  # degrees of freedom of the priors: a lens that is far from usual is believed when the images insist
MAX_ITERATIONS = 40
CONVERGED = 1e-4  # relative decrease of the cost that ends the iterations
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-9, 1e9


@dataclass(frozen=True)
class State:
    """The unknowns; a camera key that is held has no intrinsics here."""

    rotations: Float  # (I, 3, 3) local_from_cam
    centres: Float  # (I, 3) local frame
    points: Float  # (N, 3) local frame
    intrinsics: Float  # (K, 8) PARAMETERS of the free keys


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations of poses and intrinsics (C, D of them) and points (P), what they share by observation."""

    cc: Any  # (D, D) sparse
    pp: Float  # (N, 3, 3)
    pose_point: Float  # (M, 6, 3)
    intrinsics_point: Float  # (K, N, 8, 3)
    c: Float  # (D,) negative gradient
    p: Float  # (N, 3)
    image: Int  # (M,)
    point: Int  # (M,)

    def eliminated(self, damping: float) -> tuple[Float, Any, Any]:
        """Return the root R of pp^-1 = R R^T (N, 3, 3), cp R (D, 3N) and the damped system of C (D, D), sparse."""
        from scipy import sparse

        trace = np.einsum("nii->n", self.pp)
        diagonal = damping * np.einsum("nii->ni", self.pp) + (LEAST_DAMPING * trace + (trace == 0.0))[:, None]
        root = np.swapaxes(np.linalg.inv(np.linalg.cholesky(self.pp + diagonal[:, :, None] * np.eye(3))), 1, 2)
        n_shared = len(self.intrinsics_point) * len(PARAMETERS)
        n_images = (len(self.c) - n_shared) // 6
        order = np.argsort(self.image, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(self.image, minlength=n_images))])
        blocks = (self.pose_point @ root[self.point])[order], self.point[order], starts
        poses = sparse.bsr_matrix(blocks, shape=(6 * n_images, 3 * len(self.pp)))
        shared = np.swapaxes(self.intrinsics_point @ root, 1, 2).reshape(n_shared, 3 * len(self.pp))
        cp = sparse.vstack([poses.tocsr(), sparse.csr_matrix(shared)], format="csr")
        damped = self.cc + (damping + LEAST_DAMPING) * sparse.diags(self.cc.diagonal())
        return root, cp, (damped - cp @ cp.T).tocsc()

    def step(self, damping: float) -> tuple[Float, Float]:
        """Return the damped step of poses and intrinsics (D,) and of the points (N, 3)."""
        root, cp, matrix = self.eliminated(damping)
        p = np.einsum("nji,nj->ni", root, self.p).ravel()
        dc = self._solved(matrix, self.c - cp @ p)
        return dc, np.einsum("nij,nj->ni", root, (p - cp.T @ dc).reshape(-1, 3))

    def intrinsics_covariance(self) -> Float:
        """Return the covariance (8K, 8K) of the free intrinsics, poses and points marginalised."""
        n_shared = len(self.intrinsics_point) * len(PARAMETERS)
        wanted = np.eye(len(self.c))[:, len(self.c) - n_shared :]
        return self._solved(self.eliminated(0.0)[2], wanted)[len(self.c) - n_shared :]

    def _solved(self, matrix: Any, right: Float) -> Float:
        """Solve the system of C scaled to a unit diagonal of `cc`, where rotations and metres are alike."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        scale = 1.0 / np.sqrt(self.cc.diagonal())
        scaled = (sparse.diags(scale) @ matrix @ sparse.diags(scale)).tocsc()
        columns = scale.reshape(-1, *[1] * (right.ndim - 1))
        solver = splu(scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return np.asarray(columns * solver.solve(columns * right))


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
    adjustable: Bool  # (8,) which of PARAMETERS may change

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
        squared = np.sum(self.residuals(state) ** 2, axis=1)
        unknowns = 3 * len(state.points) + 6 * len(self.keys)
        redundancy = max(1.0 - unknowns / (2.0 * len(squared)), 0.05)
        return float(max(np.sqrt(np.median(squared) / (2.0 * np.log(2.0)) / redundancy), 1e-6))  # Rayleigh's median

    def cost(self, state: State, noise_px: float) -> float:
        """Return half the weighted Huber cost plus the priors'; infinite with a point behind its camera."""
        ratio = np.linalg.norm(self.residuals(state), axis=1) / noise_px
        if not np.isfinite(ratio).all():
            return np.inf
        huber = np.where(ratio <= HUBER, 0.5 * ratio**2, HUBER * (ratio - 0.5 * HUBER))
        prior = 0.5 * STUDENT * np.log1p(self.deviation(state) ** 2 / STUDENT)
        return float(self.weight @ huber + prior.sum())

    def deviation(self, state: State) -> Float:
        """Return the intrinsics minus the prior mean (K, 8), in standard deviations of the priors."""
        return np.asarray(np.einsum("kij,kj->ki", self.whitening, state.intrinsics - self.mean))

    def normal_equations(self, state: State, noise_px: float) -> NormalEquations:
        """Return the normal equations of the reweighted residuals and priors."""
        residual = self.residuals(state)
        ratio = np.linalg.norm(residual, axis=1) / noise_px
        root = np.sqrt(self.weight * np.minimum(1.0, HUBER / np.maximum(ratio, 1e-12))) / noise_px
        residual = root[:, None] * residual
        by_pose, by_intrinsics, by_point = (root[:, None, None] * jacobian for jacobian in self.jacobians(state))
        cc, c = self._poses_and_intrinsics(by_pose, by_intrinsics, residual)
        prior_cc, prior_c = self._priors(state)
        point_t, intrinsics_t = np.swapaxes(by_point, 1, 2), np.swapaxes(by_intrinsics, 1, 2)
        n = len(state.points)
        shared = [self._by_point(intrinsics_t @ by_point * self._rows(key)[:, None, None], n) for key in self.free]
        return NormalEquations(
            cc=cc + prior_cc,
            pp=self._by_point(point_t @ by_point, n),
            pose_point=np.swapaxes(by_pose, 1, 2) @ by_point,
            intrinsics_point=np.array(shared).reshape(-1, n, len(PARAMETERS), 3),
            c=c + prior_c,
            p=self._by_point(np.einsum("mki,mk->mi", by_point, residual), n),
            image=self.image,
            point=self.point,
        )

    def jacobians(self, state: State) -> tuple[Float, Float, Float]:
        """Return d pixel / d (rotation, centre) (M, 2, 6), d intrinsics (M, 2, 8) and d point (M, 2, 3).

        A rotation is perturbed on the camera's side, R exp(w); intrinsics that are held have zeros.
        """
        seen = self._in_camera(state)
        by_seen, by_intrinsics = np.empty((len(seen), 2, 3)), np.zeros((len(seen), 2, len(PARAMETERS)))
        for key in set(self.keys):
            rows = self._rows(key)
            by_seen[rows], derivative = projection_jacobians(self.camera(key, state), seen[rows])
            if key in self.free:
                by_intrinsics[rows] = derivative * self.adjustable
        by_point = by_seen @ np.swapaxes(state.rotations, 1, 2)[self.image]
        by_rotation = np.cross(by_seen, seen[:, None, :])  # the point moves by seen x w
        return np.concatenate([by_rotation, -by_point], axis=2), by_intrinsics, by_point

    def moved(self, state: State, dc: Float, dp: Float) -> State:
        """Return the state after a step of poses and intrinsics (D,) and points (N, 3)."""
        poses = dc[: 6 * len(self.keys)].reshape(-1, 6)
        turned = np.array([r @ rotation_exp(w) for r, w in zip(state.rotations, poses[:, :3], strict=True)])
        intrinsics = state.intrinsics + dc[6 * len(self.keys) :].reshape(state.intrinsics.shape)
        return State(turned, state.centres + poses[:, 3:], state.points + dp, intrinsics)

    def minimised(self, state: State, noise_px: float) -> tuple[State, int]:
        """Return the state of least cost near this one, and the number of iterations."""
        cost, damping = self.cost(state, noise_px), FIRST_DAMPING
        for iteration in range(1, MAX_ITERATIONS + 1):
            normal = self.normal_equations(state, noise_px)
            trial = self.moved(state, *normal.step(damping))
            while not self.cost(trial, noise_px) <= cost:
                damping *= 10.0
                if damping > MOST_DAMPING:
                    return state, iteration
                trial = self.moved(state, *normal.step(damping))
            decrease = cost - self.cost(trial, noise_px)
            state, cost, damping = trial, cost - decrease, max(damping / 10.0, LEAST_DAMPING)
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

    def _poses_and_intrinsics(self, by_pose: Float, by_intrinsics: Float, residual: Float) -> tuple[Any, Float]:
        """Return the sparse matrix (D, D) and the right side (D,) of the poses and intrinsics."""
        from scipy import sparse

        n_images, n_keys = len(self.keys), len(self.free)
        pose_t, intrinsics_t = np.swapaxes(by_pose, 1, 2), np.swapaxes(by_intrinsics, 1, 2)
        key = np.array([self.free.index(k) if k in self.free else -1 for k in self.keys])
        of_free = np.flatnonzero(key >= 0)
        poses = sparse.block_diag(self._by_image(pose_t @ by_pose))
        size = len(PARAMETERS)
        mixed = sparse.lil_matrix((6 * n_images, size * n_keys))
        own, shared = np.zeros((n_keys, size, size)), np.zeros((n_keys, size))
        crossed, squared = self._by_image(pose_t @ by_intrinsics), self._by_image(intrinsics_t @ by_intrinsics)
        for image in of_free:
            mixed[6 * image : 6 * image + 6, size * key[image] : size * (key[image] + 1)] = crossed[image]
            own[key[image]] += squared[image]
        gradient = self._by_image(np.einsum("mki,mk->mi", by_intrinsics, residual))
        np.add.at(shared, key[of_free], gradient[of_free])
        right = np.append(self._by_image(np.einsum("mki,mk->mi", by_pose, residual)), shared)
        if n_keys == 0:
            return poses.tocsr(), right
        return sparse.bmat([[poses, mixed], [mixed.T, sparse.block_diag(own)]], format="csr"), right

    def _by_image(self, values: Float) -> Float:
        order = np.argsort(self.image, kind="stable")
        rows = self.image[order]
        starts = np.flatnonzero(np.diff(rows, prepend=-1))
        total = np.zeros((len(self.keys), *values.shape[1:]))
        total[rows[starts]] = np.add.reduceat(values[order], starts)
        return total

    def _priors(self, state: State) -> tuple[Any, Float]:
        """Return what the priors add to matrix (D, D) and right side (D,)."""
        from scipy import sparse

        first = 6 * len(self.keys)
        blocks, right = [sparse.csr_matrix((first, first))], [np.zeros(first)]
        for whitening, deviation in zip(self.whitening, self.deviation(state), strict=True):
            weighted = whitening.T / (1.0 + deviation**2 / STUDENT)
            blocks.append(sparse.csr_matrix(weighted @ whitening))
            right.append(-weighted @ deviation)
        return sparse.block_diag(blocks, format="csr"), np.concatenate(right)
