"""Pose graph optimisation (Eq. 15-16): Sim(3) between submaps by default, the paper's SE(3) between frames as preset.

The solver sits behind `PoseGraphSolver`, because gtsam has no wheels for Windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from ..errors import MissingDependencyError
from ..geometry.transforms import Rigid3, Sim3
from ..records import Edge, FrameEdge
from .state import MapState

HUBER = 1.345  # whitened units
MAX_ITERATIONS = 30


class PoseGraphSolver(Protocol):
    """Robust least squares over poses; the node `fixed` keeps its pose."""

    def solve_sim3(self, nodes: Mapping[int, Sim3], edges: Sequence[Edge], fixed: int) -> dict[int, Sim3]:
        """Return optimised map_from_submap of all nodes."""
        ...

    def solve_se3(self, nodes: Mapping[int, Rigid3], edges: Sequence[FrameEdge], fixed: int) -> dict[int, Rigid3]:
        """Return optimised map_from_cam of all nodes."""
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


def optimise_submaps(state: MapState, solver: PoseGraphSolver) -> float:
    """Move the submaps to agree with all edges (Eq. 16 on Sim(3)); return the largest shift in scene spacings."""
    if not has_loops(len(state.map_from_submap), state.edges):
        return 0.0
    before = {index: state.map_from_cam(index).translation for index in state.frames}
    state.move_submaps(solver.solve_sim3(state.map_from_submap, state.edges, fixed=0))
    shift = max(float(abs(state.map_from_cam(i).translation - before[i]).max()) for i in before)
    return shift / state.spacing


def optimise_frames(state: MapState, solver: PoseGraphSolver) -> None:
    """Move only the camera poses (the paper's graph, Eq. 15-16 on SE(3)); cloud and references stay."""
    nodes = {index: state.map_from_cam(index) for index in state.frames}
    if state.frame_edges:
        state.move_frames(solver.solve_se3(nodes, state.frame_edges, fixed=next(iter(state.frames))))


def has_loops(n_nodes: int, edges: Sequence[Edge]) -> bool:
    """Return whether a connected graph has more edges than a tree: only then is there anything to balance."""
    return len(edges) > n_nodes - 1
