"""The two pose graph solvers on the same graphs: cost, error against the truth, CPU seconds.

    python benchmarks/pose_graph_solvers.py [--nodes 100 1000 5000] [--outliers 0.02] [--oracle VIEWS]

A graph is that of a block flight: submaps of six new frames that saw twelve older ones, every view with noise of its
own, and a share of the views placed wrong. It starts as the online registration leaves it, one submap fitted to the one
before, so that it has drifted. gtsam computes the cost of both. With --oracle VIEWS the graphs of a whole run on
simulated views are solved instead.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from onthefly3r.geometry.transforms import Sim3
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.graph.gtsam_solver import GtsamSolver
from onthefly3r.graph.sightings import FRAMES
from onthefly3r.graph.solver import PoseGraphSolver, PosePrior
from onthefly3r.graph.sparse_solver import SparseSolver
from onthefly3r.records import Edge

NEW, SEEN, STRIP = 6, 12, 40
SIGMA = np.array([0.002, 0.002, 0.002, 0.02, 0.02, 0.02, 0.002])  # rotation rad, position, log scale; base is 1


@dataclass(frozen=True)
class Graph:
    """What a solver is given, and where its frames and submaps really are."""

    nodes: dict[int, Sim3]
    edges: list[Edge]
    priors: list[PosePrior]
    truth: dict[int, Sim3]


def block_flight(nodes: int, outliers: float, seed: int = 0) -> Graph:
    """Return a graph of about so many nodes."""
    rng = np.random.default_rng(seed)
    submaps = max(2, round(nodes / (NEW + 1)))
    count = NEW * submaps
    strip, along = np.divmod(np.arange(count), STRIP)
    along = np.where(strip % 2, STRIP - 1 - along, along)
    places = np.stack([along, 2.0 * strip, 0.1 * rng.standard_normal(count)], axis=1).astype(float)
    truth = {
        FRAMES + i: Sim3.exp(np.r_[0.1 * rng.standard_normal(3), place, 0.3 * rng.standard_normal()])
        for i, place in enumerate(places)
    }
    edges, start = [], {}
    for k in range(submaps):
        own = range(NEW * k, NEW * (k + 1))
        middle = places[list(own)].mean(axis=0)
        truth[k] = Sim3.exp(np.r_[0.1 * rng.standard_normal(3), middle, 0.3 * rng.standard_normal()])
        near = np.argsort(np.linalg.norm(places[: NEW * k] - middle, axis=1))[: 2 * SEEN]
        again = rng.permutation(near)[:SEEN]
        for i in (*own, *again):
            centre = Sim3(1.0, np.eye(3), truth[k].inverse().apply(places[i]))
            sigma = SIGMA * (50.0 if i in again and rng.random() < outliers else 1.0)
            error = centre @ Sim3.exp(sigma * rng.standard_normal(7)) @ centre.inverse()
            about = centre.adjoint()
            covariance = about @ np.diag(SIGMA**2) @ about.T
            edges.append(Edge(FRAMES + int(i), k, truth[FRAMES + i].inverse() @ truth[k] @ error, covariance))
            if k == 0:
                start[0] = truth[0]
            elif k not in start and i in again and FRAMES + i in start:
                start[k] = start[FRAMES + i] @ edges[-1].source_from_target
        for edge in edges[-NEW - len(again) :][:NEW]:
            start[edge.source] = start[k] @ edge.source_from_target.inverse()
    return Graph({node: start[node] for node in truth}, edges, [], truth)


class Listener(SparseSolver):
    """Remembers the graphs that a run gives it to solve."""

    def __init__(self) -> None:
        self.heard: list[tuple[dict[int, Sim3], list[Edge], list[PosePrior]]] = []

    def solve_sim3(
        self, nodes: Mapping[int, Sim3], edges: Sequence[Edge], priors: Sequence[PosePrior], fixed: int
    ) -> dict[int, Sim3]:
        """Solve the graph, and keep it."""
        self.heard.append((dict(nodes), list(edges), list(priors)))
        return super().solve_sim3(nodes, edges, priors, fixed)


def oracle_graphs(views: int) -> list[Graph]:
    """Return the graphs that a run on simulated views solves at its end."""
    from onthefly3r.engine.loop import Engine
    from onthefly3r.options import Options
    from onthefly3r.simulate.oracle import OracleBackbone, OracleDescriber, oracle_images, oracle_shots, scenario

    survey = scenario(views, max(2, round((views / 2) ** 0.5)))
    by_name = {image.shot.name: image for image in oracle_images(survey, 96).values()}
    listener = Listener()
    with tempfile.TemporaryDirectory() as work:
        engine = Engine(
            Path(work),
            Options.from_flat({"refine": False}),
            OracleBackbone(survey, None, None, 0, False, 96),
            OracleDescriber(survey, seed=0),
            lambda shot: by_name[shot.name],
        )
        engine._solver = listener
        engine.add_all(oracle_shots(survey))
        engine.finish()
        truth = {
            FRAMES + i: Sim3(1.0, np.eye(3), survey.views[i].enu_from_cam.translation) for i in engine.state.frames
        }
    return [Graph(*heard, truth) for heard in listener.heard[-2:]]


def cost(graph: Graph, poses: Mapping[int, Sim3]) -> float:
    """Return what both minimise, as gtsam computes it."""
    factors, values = GtsamSolver.problem(poses, graph.edges, graph.priors, fixed=0)
    return float(factors.error(values))


def ate(graph: Graph, poses: Mapping[int, Sim3]) -> float:
    """Return the RMS distance of frames from the truth after the best similarity."""
    frames = [node for node in graph.nodes if node >= FRAMES]
    found, true = (np.array([of[node].translation for node in frames]) for of in (poses, graph.truth))
    fitted = weighted_similarity(found, true, np.ones(len(frames))).apply(found)
    return float(np.sqrt(((fitted - true) ** 2).sum(axis=1).mean()))


def compare(name: str, graph: Graph) -> None:
    """Print one line for each solver."""
    solvers: dict[str, PoseGraphSolver] = {"gtsam": GtsamSolver(), "sparse": SparseSolver()}
    print(f"{name}: start".ljust(32), f"{cost(graph, graph.nodes):14.4f} {ate(graph, graph.nodes):9.5f}")
    for solver_name, solver in solvers.items():
        before = time.process_time()
        poses = solver.solve_sim3(graph.nodes, graph.edges, graph.priors, fixed=0)
        seconds = time.process_time() - before
        print(f"{name}: {solver_name}".ljust(32), f"{cost(graph, poses):14.4f} {ate(graph, poses):9.5f} {seconds:8.2f}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[100, 1000, 5000], help="sizes of the graphs")
    parser.add_argument("--outliers", type=float, default=0.02, help="share of the views that are placed wrong")
    parser.add_argument("--oracle", type=int, help="solve the graphs of a run on so many simulated views instead")
    chosen = parser.parse_args()
    print("graph, solver".ljust(32), f"{'cost':>14} {'ATE':>9} {'CPU s':>8}")
    if chosen.oracle:
        for graph in oracle_graphs(chosen.oracle):
            compare(f"oracle, {len(graph.nodes)} nodes", graph)
        return
    for nodes in chosen.nodes:
        graph = block_flight(nodes, chosen.outliers)
        compare(f"block, {len(graph.nodes)} nodes", graph)


if __name__ == "__main__":
    main()
