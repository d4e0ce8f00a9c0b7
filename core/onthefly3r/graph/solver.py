"""What a pose graph solver takes and gives, whatever library it stands on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3
from ..records import Edge, FrameEdge

HUBER = 1.345  # whitened units
MAX_ITERATIONS = 30


@dataclass(frozen=True)
class PosePrior:
    """What is known of a submap's pose from outside the map."""

    submap: int
    map_from_submap: Sim3
    information: Float  # (7, 7) of [rotation rad, translation, log scale], right perturbation; may be singular
    middle: Float = field(default_factory=lambda: np.zeros(3))  # (3,) of the cameras that it is known from, submap


class PoseGraphSolver(Protocol):
    """Robust least squares over poses."""

    def solve_sim3(
        self, nodes: Mapping[int, Sim3], edges: Sequence[Edge], priors: Sequence[PosePrior], fixed: int
    ) -> dict[int, Sim3]:
        """Return optimised poses of all nodes; without priors the node `fixed` keeps its pose."""
        ...

    def solve_se3(self, nodes: Mapping[int, Rigid3], edges: Sequence[FrameEdge], fixed: int) -> dict[int, Rigid3]:
        """Return optimised map_from_cam of all nodes; the node `fixed` keeps its pose."""
        ...


def floored(symmetric: Float) -> Float:
    """Keep covariances or informations (..., D, D) invertible where a direction is all but perfectly known or open."""
    values, vectors = np.linalg.eigh(0.5 * (symmetric + np.swapaxes(symmetric, -1, -2)))
    kept = np.maximum(values, 1e-10 * values.max(axis=-1, keepdims=True))
    return np.asarray((vectors * kept[..., None, :]) @ np.swapaxes(vectors, -1, -2))
