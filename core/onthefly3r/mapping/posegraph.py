"""Pose graph optimisation (Eq. 15-16): Sim(3) between submaps by default, the paper's SE(3) between frames as preset.

The solver sits behind `PoseGraphSolver`, because gtsam has no wheels for Windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..errors import MissingDependencyError
from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, rotation_log
from ..records import Edge, FrameEdge
from .state import MapState

HUBER = 1.345  # whitened units
MAX_ITERATIONS = 30
MEDIAN_MISFIT = 6.35  # of a chi-squared variable of seven degrees of freedom
OUTLYING_PRIOR = 50.0  # times the usual squared misfit


@dataclass(frozen=True)
class PosePrior:
    """What is known of a submap's pose from outside the map."""

    submap: int
    map_from_submap: Sim3
    information: Float  # (7, 7) of [rotation rad, translation, log scale], right perturbation; may be singular


class PoseGraphSolver(Protocol):
    """Robust least squares over poses."""

    def solve_sim3(
        self, nodes: Mapping[int, Sim3], edges: Sequence[Edge], priors: Sequence[PosePrior], fixed: int
    ) -> dict[int, Sim3]:
        """Return optimised map_from_submap of all nodes; without priors the node `fixed` keeps its pose."""
        ...

    def solve_se3(self, nodes: Mapping[int, Rigid3], edges: Sequence[FrameEdge], fixed: int) -> dict[int, Rigid3]:
        """Return optimised map_from_cam of all nodes; the node `fixed` keeps its pose."""
        ...


def default_solver() -> PoseGraphSolver:
    """Return the gtsam solver; raises `MissingDependencyError` where gtsam is not installed."""
    try:
        import gtsam  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "gtsam is not installed, so drift cannot be removed; install it (it has wheels for Linux and macOS) "
            "or choose --pose-graph none"
        ) from error
    from .gtsam_solver import GtsamSolver

    return GtsamSolver()


def optimise_submaps(state: MapState, solver: PoseGraphSolver, priors: Sequence[PosePrior] = ()) -> float:
    """Move the submaps to agree with all edges and priors (Eq. 16 on Sim(3)); return the largest shift in spacings.

    Priors that contradict their neighbours are left out. Once the map has settled, the edges' covariances grow to the
    misfits that are left, and it settles once more: local models that all bend alike contradict each other more than
    their points show.
    """
    priors = consistent_priors(priors, state.edges)
    if not priors and not has_loops(len(state.map_from_submap), state.edges):
        return 0.0
    before = {index: state.map_from_cam(index).translation for index in state.frames}
    solved = solver.solve_sim3(state.map_from_submap, state.edges, priors, fixed=0)
    if priors:
        solved = solver.solve_sim3(solved, honest_edges(solved, state.edges), priors, fixed=0)
    state.move_submaps(solved)
    shift = max(float(np.abs(state.map_from_cam(i).translation - before[i]).max()) for i in before)
    return shift / state.spacing


def consistent_priors(priors: Sequence[PosePrior], edges: Sequence[Edge]) -> list[PosePrior]:
    """Return the priors that most of their submaps' edges lead to from the priors at the other end.

    A map that has bent as a whole misfits all of them alike; a wrong one stands out.
    """
    prior_of = {prior.submap: prior for prior in priors}
    covariance_of = {prior.submap: np.linalg.inv(floored(prior.information)) for prior in priors}
    misfits: dict[int, list[float]] = {submap: [] for submap in prior_of}
    for edge in edges:
        if edge.source in prior_of and edge.target in prior_of:
            source, target = prior_of[edge.source], prior_of[edge.target]
            step = tangent(
                edge.source_from_target.inverse() @ (source.map_from_submap.inverse() @ target.map_from_submap)
            )
            # As if both ends were known like the target: what it leaves open tells nothing.
            covariance = edge.covariance + 2.0 * covariance_of[edge.target]
            misfit = float(step @ np.linalg.solve(floored(covariance), step))
            misfits[edge.source].append(misfit)
            misfits[edge.target].append(misfit)
    # The lower median: of two neighbours one that agrees is enough.
    usual = {submap: sorted(values)[(len(values) - 1) // 2] for submap, values in misfits.items() if values}
    limit = OUTLYING_PRIOR * max(float(np.median(list(usual.values()))) if usual else 0.0, MEDIAN_MISFIT)
    return [prior for prior in priors if usual.get(prior.submap, 0.0) <= limit]


def honest_edges(nodes: Mapping[int, Sim3], edges: Sequence[Edge]) -> list[Edge]:
    """Return the edges with covariances that are as large, in the median, as the misfits at the given poses."""
    if not edges:
        return []
    steps = [tangent(e.source_from_target.inverse() @ (nodes[e.source].inverse() @ nodes[e.target])) for e in edges]
    misfit = [float(step @ np.linalg.solve(floored(e.covariance), step)) for step, e in zip(steps, edges, strict=True)]
    factor = max(1.0, float(np.median(misfit)) / MEDIAN_MISFIT)
    return [replace(edge, covariance=factor * edge.covariance) for edge in edges]


def tangent(transform: Sim3) -> Float:
    """Return [rotation rad, translation, log scale] (7,) of a transform near the identity."""
    return np.array([*rotation_log(transform.rotation), *transform.translation, np.log(transform.scale)])


def floored(symmetric: Float) -> Float:
    """Keep a covariance or information invertible where it leaves a direction all but perfectly known or open."""
    values, vectors = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
    return np.asarray((vectors * np.maximum(values, 1e-10 * values.max())) @ vectors.T)


def optimise_frames(state: MapState, solver: PoseGraphSolver) -> None:
    """Move only the camera poses (the paper's graph, Eq. 15-16 on SE(3)); cloud and references stay."""
    nodes = {index: state.map_from_cam(index) for index in state.frames}
    if state.frame_edges:
        state.move_frames(solver.solve_se3(nodes, state.frame_edges, fixed=next(iter(state.frames))))


def has_loops(n_nodes: int, edges: Sequence[Edge]) -> bool:
    """Return whether a connected graph has more edges than a tree: only then is there anything to balance."""
    return len(edges) > n_nodes - 1
