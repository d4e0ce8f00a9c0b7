"""The pose graph solver on numpy and scipy, which runs wherever these do.

Levenberg-Marquardt over right perturbations x exp(d), with the Jacobians of the group, all edges at once. SE(3) is
Sim(3) without its last direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.arrays import Float, Int
from ..geometry.similarities import Similarities, log_derivative
from ..geometry.transforms import Rigid3, Sim3
from ..records import Edge, FrameEdge
from .solver import HUBER, MAX_ITERATIONS, PosePrior, floored

CONVERGED = 1e-5  # share of the cost that a step must save to be followed by another
# Damping as a share of the normal matrix's diagonal: to begin with, least and most.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-9, 1e6


class SparseSolver:
    """Levenberg-Marquardt with a Huber kernel on every edge."""

    def solve_sim3(
        self, nodes: Mapping[int, Sim3], edges: Sequence[Edge], priors: Sequence[PosePrior], fixed: int
    ) -> dict[int, Sim3]:
        """Return optimised map_from_submap of all nodes; without priors the node `fixed` keeps its pose."""
        row_of = {node: row for row, node in enumerate(nodes)}
        between = _Residuals(
            np.array([row_of[edge.source] for edge in edges], int),
            np.array([row_of[edge.target] for edge in edges], int),
            Similarities.of(edge.source_from_target.inverse() for edge in edges),
            _whitening_of_covariance(np.array([edge.covariance for edge in edges]).reshape(-1, 7, 7)),
        )
        # No kernel on priors: where a whole map has bent, every prior is far off and right.
        known = _Priors(
            np.array([row_of[prior.submap] for prior in priors], int),
            Similarities.of(prior.map_from_submap.inverse() for prior in priors),
            _whitening_of_information(np.array([prior.information for prior in priors]).reshape(-1, 7, 7)),
        )
        kept = None if priors else row_of[fixed]
        solved = _minimise(Similarities.of(nodes.values()), between, known, kept)
        return {node: solved.single(row) for node, row in row_of.items()}

    def solve_se3(self, nodes: Mapping[int, Rigid3], edges: Sequence[FrameEdge], fixed: int) -> dict[int, Rigid3]:
        """Return optimised map_from_cam of all nodes; the node `fixed` keeps its pose."""
        row_of = {node: row for row, node in enumerate(nodes)}
        sigmas = np.array([[e.sigma_rotation_rad] * 3 + [e.sigma_translation] * 3 for e in edges]).reshape(-1, 6)
        between = _Residuals(
            np.array([row_of[edge.source] for edge in edges], int),
            np.array([row_of[edge.target] for edge in edges], int),
            Similarities.of(edge.source_from_target.inverse() for edge in edges),
            np.eye(6) / sigmas[:, None, :],
        )
        nothing = _Priors(np.zeros(0, int), Similarities.of([]), np.zeros((0, 6, 6)))
        solved = _minimise(Similarities.of(nodes.values()), between, nothing, row_of[fixed])
        return {
            node: Rigid3(solved.rotation[row].copy(), solved.translation[row].copy()) for node, row in row_of.items()
        }


@dataclass(frozen=True)
class _Residuals:
    """Edges r = W log(target_from_source x_source^-1 x_target), rows of the nodes that they join."""

    source: Int  # (E,)
    target: Int  # (E,)
    target_from_source: Similarities
    whitening: Float  # (E, D, D) with D = 7 of Sim(3) or 6 of SE(3)


@dataclass(frozen=True)
class _Priors:
    """Priors r = W log(node_from_map x_node)."""

    node: Int  # (P,)
    node_from_map: Similarities
    whitening: Float  # (P, D, D)


def _whitening_of_covariance(covariance: Float) -> Float:
    """Return W (N, D, D) with W' W the inverse of each covariance (N, D, D)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(floored(covariance))))


def _whitening_of_information(information: Float) -> Float:
    """Return W (N, D, D) with W' W each information (N, D, D)."""
    values, vectors = np.linalg.eigh(floored(information))
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.swapaxes(1, 2))


def _minimise(poses: Similarities, edges: _Residuals, priors: _Priors, kept: int | None) -> Similarities:
    """Return the poses of least cost; the row `kept` stays."""
    system = _NormalEquations(len(poses), edges, priors, kept)
    cost, damping = _cost(poses, edges, priors), FIRST_DAMPING
    if cost == np.inf or not len(system.free):
        return poses
    for _ in range(MAX_ITERATIONS):
        matrix, gradient = system.at(poses)
        growth = 10.0
        while True:
            step = system.solve(matrix, gradient, damping)
            moved = poses if step is None else poses @ Similarities.exp(step)
            new_cost = _cost(moved, edges, priors) if step is not None else np.inf
            if new_cost <= cost or damping > MOST_DAMPING:
                break
            damping, growth = damping * growth, 2.0 * growth
        if not new_cost <= cost:
            return poses
        saved = cost - new_cost
        poses, cost, damping = moved, new_cost, max(0.1 * damping, LEAST_DAMPING)
        if saved <= CONVERGED * cost:
            break
    return poses


def _missed(poses: Similarities, edges: _Residuals) -> tuple[Float, Similarities]:
    """Return the twists (E, 7) by which edges miss, and source_from_target as the poses have it."""
    source_from_target = poses[edges.source].inverse() @ poses[edges.target]
    return (edges.target_from_source @ source_from_target).log(), source_from_target


def _whitened(whitening: Float, twists: Float) -> Float:
    return np.asarray((whitening @ twists[:, : whitening.shape[2], None])[:, :, 0])


def _cost(poses: Similarities, edges: _Residuals, priors: _Priors) -> float:
    """Return half the sum of squares, of edges with Huber's loss."""
    length = np.linalg.norm(_whitened(edges.whitening, _missed(poses, edges)[0]), axis=1)
    of_edges = np.where(length <= HUBER, 0.5 * length**2, HUBER * (length - 0.5 * HUBER))
    of_priors = _whitened(priors.whitening, (priors.node_from_map @ poses[priors.node]).log())
    cost = float(of_edges.sum() + 0.5 * (of_priors**2).sum())
    return cost if np.isfinite(cost) else np.inf


class _NormalEquations:
    """J' J and -J' r as blocks of D by D, whose places stay the same from step to step."""

    def __init__(self, count: int, edges: _Residuals, priors: _Priors, kept: int | None) -> None:
        from scipy import sparse

        self._count, self._edges, self._priors = count, edges, priors
        self._size = edges.whitening.shape[2]
        self.free = np.array([row for row in range(count) if row != kept], int)
        place = np.full(count, -1)
        place[self.free] = np.arange(len(self.free))
        self.free = self.free[np.argsort(self._ordering(place[edges.source], place[edges.target]))]
        place[self.free] = np.arange(len(self.free))
        rows, cols = (
            np.concatenate([place[part] for part in parts] + [place[priors.node], np.arange(len(self.free))])
            for parts in (
                (edges.source, edges.source, edges.target, edges.target),
                (edges.source, edges.target, edges.source, edges.target),
            )
        )
        width = max(len(self.free), 1)
        used = np.flatnonzero((rows >= 0) & (cols >= 0))
        places, row = np.unique(rows[used] * width + cols[used], return_inverse=True)
        # Which blocks add up to which block of the matrix.
        self._sums = sparse.csr_matrix((np.ones(len(used)), (row, used)), shape=(len(places), len(rows)))
        block_row, self._cols = np.divmod(places, width)
        self._row_starts = np.searchsorted(block_row, np.arange(len(self.free) + 1))

    def _ordering(self, source: Int, target: Int) -> Int:
        """Return the place of each free node that keeps the factors sparse; ordering nodes is faster than numbers."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        count = len(self.free)
        if count == 0:
            return np.zeros(0, int)
        joined = (source >= 0) & (target >= 0)
        links = sparse.coo_matrix((np.ones(joined.sum()), (source[joined], target[joined])), shape=(count, count))
        links = links + links.T
        pattern = (links + sparse.diags(np.asarray(links.sum(axis=0)).ravel() + 1.0)).tocsc()
        return np.asarray(splu(pattern, **_SYMMETRIC, permc_spec="MMD_AT_PLUS_A").perm_c)

    def at(self, poses: Similarities) -> tuple[Any, Float]:
        """Return the normal matrix (D F, D F) of the F free nodes, and the downhill gradient (D F,)."""
        from scipy import sparse

        size, edges, priors = self._size, self._edges, self._priors
        missed, source_from_target = _missed(poses, edges)
        residual = _whitened(edges.whitening, missed)
        # Iteratively reweighted: an edge counts as its loss slopes.
        weight = np.sqrt(HUBER / np.maximum(np.linalg.norm(residual, axis=1), HUBER))[:, None]
        residual = weight * residual
        by_target = weight[:, :, None] * (edges.whitening @ log_derivative(missed)[:, :size, :size])
        by_source = -by_target @ source_from_target.inverse().adjoint()[:, :size, :size]
        off = (priors.node_from_map @ poses[priors.node]).log()
        by_node = priors.whitening @ log_derivative(off)[:, :size, :size]
        source_t, target_t, node_t = (part.swapaxes(1, 2) for part in (by_source, by_target, by_node))
        crossed = source_t @ by_target
        blocks = np.concatenate(
            [
                source_t @ by_source,
                crossed,
                crossed.swapaxes(1, 2),
                target_t @ by_target,
                node_t @ by_node,
                np.zeros((len(self.free), size, size)),  # a node that nothing holds still has its place
            ]
        )
        gradient = np.zeros((self._count, size))
        for rows, part, missing in (
            (edges.source, source_t, residual),
            (edges.target, target_t, residual),
            (priors.node, node_t, _whitened(priors.whitening, off)),
        ):
            np.add.at(gradient, rows, -(part @ missing[:, :, None])[:, :, 0])
        data = (self._sums @ blocks.reshape(len(blocks), size * size)).reshape(-1, size, size)
        shape = (size * len(self.free),) * 2
        rows = sparse.bsr_matrix((data, self._cols, self._row_starts), shape=shape).tocsr()
        # It is symmetric, so that its rows are its columns.
        return sparse.csc_matrix((rows.data, rows.indices, rows.indptr), shape=shape), gradient[self.free].ravel()

    def solve(self, matrix: Any, gradient: Float, damping: float) -> Float | None:
        """Return the damped step (N, 7) of all nodes, None where the system cannot be solved."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        step = np.zeros((self._count, 7))
        diagonal = matrix.diagonal()
        unit = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        col = np.repeat(np.arange(len(unit)), np.diff(matrix.indptr))
        data = matrix.data * unit[matrix.indices] * unit[col] + damping * (matrix.indices == col)
        damped = sparse.csc_matrix((data, matrix.indices, matrix.indptr), shape=matrix.shape)
        try:
            solved = unit * splu(damped, **_SYMMETRIC, permc_spec="NATURAL").solve(unit * gradient)
        except RuntimeError:  # singular
            return None
        if not np.isfinite(solved).all():
            return None
        step[self.free, : self._size] = solved.reshape(-1, self._size)
        return step


_SYMMETRIC: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
