"""The solver on scipy: against gtsam's minimum, against its own gradient, and where graphs leave something open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from onthefly3r.geometry.similarities import Similarities
from onthefly3r.geometry.transforms import Rigid3, Sim3
from onthefly3r.graph.solver import HUBER, PosePrior
from onthefly3r.graph.sparse_solver import SparseSolver
from onthefly3r.records import Edge, FrameEdge
from pose_graph_solvers import block_flight, cost

COVARIANCE = np.diag(np.array([0.002] * 3 + [0.02] * 3 + [0.002]) ** 2)


def random_poses(count: int, seed: int) -> dict[int, Sim3]:
    rng = np.random.default_rng(seed)
    return {10 * k: Sim3.exp(np.r_[rng.standard_normal(3), 5.0 * rng.standard_normal(4)] * 0.5) for k in range(count)}


def edge(poses: dict[int, Sim3], source: int, target: int, rng: np.random.Generator, size: float = 0.01) -> Edge:
    error = Sim3.exp(size * rng.standard_normal(7))
    return Edge(source, target, poses[source].inverse() @ poses[target] @ error, COVARIANCE)


def miss(e: Edge, poses: Mapping[int, Sim3]) -> Sim3:
    return e.source_from_target.inverse() @ poses[e.source].inverse() @ poses[e.target]


def far(found: dict[int, Sim3], truth: dict[int, Sim3]) -> float:
    return max(float(np.abs(found[node].matrix() - truth[node].matrix()).max()) for node in truth)


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_the_cost_is_not_above_gtsams(outliers: float) -> None:
    pytest.importorskip("gtsam")
    from onthefly3r.graph.gtsam_solver import GtsamSolver

    graph = block_flight(150, outliers)
    ours, theirs = (
        solver.solve_sim3(graph.nodes, graph.edges, graph.priors, fixed=0) for solver in (SparseSolver(), GtsamSolver())
    )
    assert cost(graph, ours) < 1.0001 * cost(graph, theirs)
    assert cost(graph, ours) < 0.6 * cost(graph, graph.nodes)
    assert ours[0] == graph.nodes[0]


def test_priors_and_edges_balance_as_in_gtsam() -> None:
    pytest.importorskip("gtsam")
    from onthefly3r.graph.gtsam_solver import GtsamSolver

    graph, rng = block_flight(100, 0.0, seed=3), np.random.default_rng(0)
    graph.priors.extend(
        PosePrior(k, graph.truth[k] @ Sim3.exp(0.01 * rng.standard_normal(7)), np.diag([0.0] * 3 + [1e3] * 3 + [0.0]))
        for k in range(14)
    )
    ours, theirs = (
        solver.solve_sim3(graph.nodes, graph.edges, graph.priors, fixed=0) for solver in (SparseSolver(), GtsamSolver())
    )
    assert cost(graph, ours) < 1.0001 * cost(graph, theirs)
    assert far(ours, theirs) < 0.02
    assert ours[0] != graph.nodes[0]


def test_at_the_minimum_no_small_step_saves_anything() -> None:
    """Without gtsam: the cost by single transforms, its slope by differences."""
    truth, rng = random_poses(8, 0), np.random.default_rng(1)
    edges = [edge(truth, a, b, rng, 0.03) for a in truth for b in truth if a < b]
    solved = SparseSolver().solve_sim3(truth, edges, [], fixed=0)
    whitening = np.linalg.inv(np.linalg.cholesky(COVARIANCE))

    def total(poses: dict[int, Sim3]) -> float:
        parts = []
        for e in edges:
            length = float(np.linalg.norm(whitening @ miss(e, poses).log()))
            parts.append(0.5 * length**2 if length < HUBER else HUBER * (length - 0.5 * HUBER))
        return sum(parts)

    least = total(solved)
    assert least < total(truth)
    for node in list(truth)[1:]:
        for k in range(7):
            for sign in (1.0, -1.0):
                step = np.zeros(7)
                step[k] = sign * 1e-4
                assert total(solved | {node: solved[node] @ Sim3.exp(step)}) > least - 1e-3


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_consistent_edges_are_met_exactly_from_far_off(size: float) -> None:
    truth, rng = random_poses(10, 2), np.random.default_rng(2)
    edges = [edge(truth, a, b, rng, 0.0) for a in truth for b in truth if a != b]
    moved = {k: pose @ Sim3.exp(size * 0.3 * rng.standard_normal(7)) if k else pose for k, pose in truth.items()}
    assert far(SparseSolver().solve_sim3(moved, edges, [], fixed=0), truth) < 1e-3


def test_correlations_of_small_noise_count_in_gtsam_too() -> None:
    pytest.importorskip("gtsam")
    graph = block_flight(50, 0.0)
    small = [Edge(e.source, e.target, e.source_from_target, 1e-8 * e.covariance) for e in graph.edges]
    whitened = [np.linalg.solve(np.linalg.cholesky(e.covariance), miss(e, graph.nodes).log()) for e in small]
    length = np.linalg.norm(whitened, axis=1)
    expected = np.where(length < HUBER, 0.5 * length**2, HUBER * (length - 0.5 * HUBER)).sum()
    assert cost(replace(graph, edges=small), graph.nodes) == pytest.approx(expected, rel=1e-4)


def test_rigid_graphs_stay_rigid_and_agree_with_gtsam() -> None:
    rng = np.random.default_rng(4)
    truth = {k: Rigid3.exp(np.r_[rng.standard_normal(3), 5.0 * rng.standard_normal(3)]) for k in range(12)}
    edges = []
    for k in range(12):
        for ahead in (1, 2, 5):
            error = Rigid3.exp(0.02 * rng.standard_normal(6))
            other = (k + ahead) % 12
            edges.append(FrameEdge(k, other, truth[k].inverse() @ truth[other] @ error, 0.01, 0.05, "ref"))
    found = SparseSolver().solve_se3(truth, edges, fixed=3)
    assert found[3] == truth[3]
    for pose in found.values():
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    pytest.importorskip("gtsam")
    from onthefly3r.graph.gtsam_solver import GtsamSolver

    theirs = GtsamSolver().solve_se3(truth, edges, fixed=3)
    for k in truth:
        np.testing.assert_allclose(found[k].matrix(), theirs[k].matrix(), atol=2e-3)


def test_what_nothing_holds_stays_where_it_is() -> None:
    """A node without an edge, and a part of the graph that no edge joins to the fixed node."""
    truth, rng = random_poses(6, 5), np.random.default_rng(5)
    edges = [edge(truth, 0, 10, rng), edge(truth, 20, 30, rng)]
    found = SparseSolver().solve_sim3(truth, edges, [], fixed=0)
    assert found[40] == truth[40] and found[50] == truth[50]
    for one in edges:
        between = found[one.source].inverse() @ found[one.target]
        np.testing.assert_allclose(between.matrix(), one.source_from_target.matrix(), atol=1e-4)
    np.testing.assert_allclose(found[20].matrix(), truth[20].matrix(), atol=0.3)


def test_graphs_of_nothing() -> None:
    truth = random_poses(2, 6)
    assert SparseSolver().solve_sim3(truth, [], [], fixed=0) == truth
    assert SparseSolver().solve_sim3({0: truth[0]}, [], [], fixed=0) == {0: truth[0]}
    prior = PosePrior(10, truth[0], np.linalg.inv(COVARIANCE))
    found = SparseSolver().solve_sim3(truth, [], [prior], fixed=0)
    np.testing.assert_allclose(found[10].matrix(), truth[0].matrix(), atol=1e-6)


def test_no_step_at_all_is_better_than_a_wrong_one() -> None:
    """Where a number is not finite nothing moves."""
    truth = random_poses(3, 7)
    broken = Edge(0, 10, Sim3(1.0, np.eye(3), np.array([np.nan, 0.0, 0.0])), COVARIANCE)
    found = SparseSolver().solve_sim3(truth, [broken], [], fixed=0)
    assert found == truth
    assert np.isfinite(Similarities.of(found.values()).translation).all()
