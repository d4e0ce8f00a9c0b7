"""The normal equations of a bundle adjustment: points eliminated, the rest sparse (Triggs et al. 2000)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.arrays import Float, Int

LEAST_DAMPING = 1e-9


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations of poses and shared unknowns (C, D of them) and points (P), what they share by observation.

    C holds six unknowns an image, then the S shared ones: intrinsics, of which points depend, and biases.
    """

    cc: Any  # (D, D) sparse
    pp: Float  # (N, 3, 3)
    pose_point: Float  # (M, 6, 3)
    shared_point: Float  # (S, N, 3)
    c: Float  # (D,) negative gradient
    p: Float  # (N, 3)
    image: Int  # (M,)
    point: Int  # (M,)

    @property
    def n_poses(self) -> int:
        """Number of unknowns of the poses; the shared ones follow."""
        return len(self.c) - len(self.shared_point)

    def eliminated(self, damping: float) -> tuple[Float, Any, Any]:
        """Return the root R of pp^-1 = R R^T (N, 3, 3), cp R (D, 3N) and the damped system of C (D, D), sparse."""
        from scipy import sparse

        trace = np.einsum("nii->n", self.pp)
        diagonal = damping * np.einsum("nii->ni", self.pp) + (LEAST_DAMPING * trace + (trace == 0.0))[:, None]
        root = np.swapaxes(np.linalg.inv(np.linalg.cholesky(self.pp + diagonal[:, :, None] * np.eye(3))), 1, 2)
        n_images = self.n_poses // 6
        order = np.argsort(self.image, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(self.image, minlength=n_images))])
        blocks = (self.pose_point @ root[self.point])[order], self.point[order], starts
        poses = sparse.bsr_matrix(blocks, shape=(6 * n_images, 3 * len(self.pp)))
        shared = np.einsum("sni,nij->snj", self.shared_point, root).reshape(len(self.shared_point), 3 * len(self.pp))
        cp = sparse.vstack([poses.tocsr(), sparse.csr_matrix(shared)], format="csr")
        damped = self.cc + (damping + LEAST_DAMPING) * sparse.diags(self.cc.diagonal())
        return root, cp, (damped - cp @ cp.T).tocsc()

    def step(self, damping: float) -> tuple[Float, Float]:
        """Return the damped step of poses and shared unknowns (D,) and of the points (N, 3)."""
        root, cp, matrix = self.eliminated(damping)
        p = np.einsum("nji,nj->ni", root, self.p).ravel()
        dc = self._solver(matrix)(self.c - cp @ p)
        return dc, np.einsum("nij,nj->ni", root, (p - cp.T @ dc).reshape(-1, 3))

    def covariance_of(self, unknowns: Sequence[int] | Int) -> Float:
        """Return the covariance (U, U) of some of the unknowns of C, everything else marginalised."""
        wanted = np.zeros((len(self.c), len(unknowns)))
        wanted[unknowns, np.arange(len(unknowns))] = 1.0
        return np.asarray(self.covariance_solver()(wanted)[unknowns])

    def shared_covariance(self) -> Float:
        """Return the covariance (S, S) of the shared unknowns, poses and points marginalised."""
        return self.covariance_of(np.arange(self.n_poses, len(self.c)))

    def covariance_solver(self) -> Any:
        """Return the function that multiplies right sides (D,) or (D, k) of C by the covariance of C."""
        return self._solver(self.eliminated(0.0)[2])

    def samples(self, count: int, seed: int) -> Float:
        """Return draws (D, count) from the normal distribution whose covariance is that of C."""
        factor, scale = self._factor(self.eliminated(0.0)[2])
        # P S P' = L D L' with U = D L': P' L sqrt(D) z has the covariance S, and S^-1 times that has S^-1.
        z = np.random.default_rng(seed).standard_normal((len(self.c), count))
        root = factor.L @ (np.sqrt(np.maximum(factor.U.diagonal(), 0.0))[:, None] * z)
        return np.asarray(scale[:, None] * factor.solve(root[factor.perm_r]))

    def _solver(self, matrix: Any) -> Any:
        """Return the function that solves the system of C for right sides (D,) or (D, k)."""
        factor, scale = self._factor(matrix)

        def solved(right: Float) -> Float:
            columns = scale.reshape(-1, *[1] * (right.ndim - 1))
            return np.asarray(columns * factor.solve(columns * right))

        return solved

    def _factor(self, matrix: Any) -> tuple[Any, Float]:
        """Return the factors of the system of C, scaled to a unit diagonal of `cc`: rotations and metres are alike."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        scale = 1.0 / np.sqrt(self.cc.diagonal())
        scaled = (sparse.diags(scale) @ matrix @ sparse.diags(scale)).tocsc()
        options = {"SymmetricMode": True}
        return splu(scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options), scale
