"""The pose graph solver on gtsam."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3
from ..records import Edge, FrameEdge
from .solver import HUBER, MAX_ITERATIONS, PosePrior, floored


class GtsamSolver:
    """Levenberg-Marquardt with a Huber kernel on every edge."""

    def solve_sim3(
        self, nodes: Mapping[int, Sim3], edges: Sequence[Edge], priors: Sequence[PosePrior], fixed: int
    ) -> dict[int, Sim3]:
        """Return optimised map_from_submap of all nodes; without priors the node `fixed` keeps its pose."""
        graph, values = self.problem(nodes, edges, priors, fixed)
        solved = _optimise(graph, values)
        return {key: from_similarity3(solved.atSimilarity3(key)) for key in nodes}

    @staticmethod
    def problem(
        nodes: Mapping[int, Sim3], edges: Sequence[Edge], priors: Sequence[PosePrior], fixed: int
    ) -> tuple[Any, Any]:
        """Return the factor graph and the values that gtsam optimises."""
        import gtsam

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in nodes.items():
            values.insert(key, to_similarity3(pose))
        if not priors:
            graph.add(gtsam.NonlinearEqualitySimilarity3(fixed, to_similarity3(nodes[fixed])))
        for prior in priors:
            # No kernel: where a whole map has bent, every prior is far off and right.
            # False: gtsam otherwise takes what is below 1e-9 off the diagonal for zero.
            noise = gtsam.noiseModel.Gaussian.Information(floored(prior.information), False)
            graph.add(gtsam.PriorFactorSimilarity3(prior.submap, to_similarity3(prior.map_from_submap), noise))
        for edge in edges:
            graph.add(
                gtsam.BetweenFactorSimilarity3(
                    edge.source,
                    edge.target,
                    to_similarity3(edge.source_from_target),
                    _robust(floored(edge.covariance)),
                )
            )
        return graph, values

    def solve_se3(self, nodes: Mapping[int, Rigid3], edges: Sequence[FrameEdge], fixed: int) -> dict[int, Rigid3]:
        """Return optimised map_from_cam of all nodes."""
        import gtsam

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in nodes.items():
            values.insert(key, _to_pose3(pose))
        graph.add(gtsam.NonlinearEqualityPose3(fixed, _to_pose3(nodes[fixed])))
        for edge in edges:
            variance = [edge.sigma_rotation_rad**2] * 3 + [edge.sigma_translation**2] * 3
            graph.add(
                gtsam.BetweenFactorPose3(
                    edge.source, edge.target, _to_pose3(edge.source_from_target), _robust(np.diag(variance))
                )
            )
        solved = _optimise(graph, values)
        poses = {key: solved.atPose3(key) for key in nodes}
        return {key: Rigid3(p.rotation().matrix(), np.asarray(p.translation())) for key, p in poses.items()}


def to_similarity3(transform: Sim3) -> Any:
    """Return the gtsam form, which means T.p = s (R p + t): its t is our translation over the scale."""
    import gtsam

    return gtsam.Similarity3(gtsam.Rot3(transform.rotation), transform.translation / transform.scale, transform.scale)


def from_similarity3(transform: Any) -> Sim3:
    """Return our form of a gtsam Similarity3; the translation is where the origin goes."""
    return Sim3(
        float(transform.scale()), transform.rotation().matrix(), np.asarray(transform.transformFrom(np.zeros(3)))
    )


def _to_pose3(pose: Rigid3) -> Any:
    import gtsam

    return gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation)


def _robust(covariance: Float) -> Any:
    import gtsam

    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance, False)
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER), gaussian)


def _optimise(graph: Any, values: Any) -> Any:
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(MAX_ITERATIONS)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
