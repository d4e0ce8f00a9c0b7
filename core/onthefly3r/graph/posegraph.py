"""Pose graph optimisation (Eq. 15-16): Sim(3) of submaps and frames by default, the paper's SE(3) graph as preset.

Nodes are the submaps and those frames that more than one submap saw. An edge joins a frame to each submap that saw it,
the one that predicted it and those that it was a reference for: the errors of views are independent, whereas relative
poses of submaps that share a reference err together.

The solver sits behind `PoseGraphSolver`, because gtsam has no wheels for Windows and others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..geometry.transforms import Sim3
from ..map.state import MapState
from ..records import Edge, Sighting
from .bending import Bending, estimate, found_so_far
from .sightings import (
    FRAMES,
    LEAST_NOISE,
    fitted,
    misfits_at_camera,
    shared_sightings,
    submap_edges,
    tangent,
    view_edge,
    view_noise,
)
from .solver import PoseGraphSolver, PosePrior, floored
from .sparse_solver import SparseSolver

MEDIAN_MISFIT = 6.35  # of a chi-squared variable of seven degrees of freedom
OUTLYING_PRIOR = 10.0  # times the usual squared misfit
ROUNDS = 3  # of looking for bends in what does not agree yet, and of solving the graph without them


def default_solver() -> PoseGraphSolver:
    """Return the solver on gtsam, which is the faster one, or that on scipy where gtsam is missing or does not load."""
    try:
        import gtsam  # noqa: F401
    except ImportError:
        return SparseSolver()
    from .gtsam_solver import GtsamSolver

    return GtsamSolver()


def optimise_submaps(state: MapState, solver: PoseGraphSolver, priors: Sequence[PosePrior] = ()) -> float:
    """Move submaps and frames to agree with all sightings and priors (Eq. 16 on Sim(3)); return the largest shift.

    A frame that several submaps saw goes to the mean of what they say, others follow their submap, straightened as far
    as that was found bent. How well a view is known within its local model, and how much local models bend, is not
    assumed: it is what the misfits show, first as the map is and then as it settles. Priors that contradict their
    neighbours are left out. The shift is in spacings.
    """
    sightings = shared_sightings(state)
    tree = len(sightings) <= fitted(sightings)
    if not sightings or (tree and not priors):  # nothing to balance
        return 0.0
    nodes = dict(state.map_from_submap)
    nodes |= {FRAMES + seen.frame: state.submap_pose_of(seen.frame) for seen in sightings}
    before = {index: state.map_from_cam(index).translation for index in state.frames}
    bending = found_so_far(state)
    nodes = _balance(nodes, sightings, bending, state, solver, priors)
    for _ in range(ROUNDS):
        bending = estimate(nodes, sightings, bending, LEAST_NOISE * state.spacing)
        nodes = _balance(nodes, sightings, bending, state, solver, priors)
    of_frames = {
        index: nodes[frame.submap] @ bending.straight_from_bent(frame.submap, frame.submap_from_cam.translation)
        for index, frame in state.frames.items()
    }
    of_frames |= {node - FRAMES: pose for node, pose in nodes.items() if node >= FRAMES}
    map_from_submap = {node: pose for node, pose in nodes.items() if node < FRAMES}
    state.move_submaps(map_from_submap, of_frames, bending.curvatures_of)
    shift = max(float(np.abs(state.map_from_cam(i).translation - before[i]).max()) for i in before)
    return shift / state.spacing


def _balance(
    nodes: Mapping[int, Sim3],
    sightings: Sequence[Sighting],
    bending: Bending,
    state: MapState,
    solver: PoseGraphSolver,
    priors: Sequence[PosePrior],
) -> dict[int, Sim3]:
    """Return the nodes as they agree best once the submaps are straightened."""
    straight = bending.straightened(sightings)
    noise = view_noise(misfits_at_camera(nodes, straight), straight, LEAST_NOISE * state.spacing)
    edges = [view_edge(seen, state.map_from_submap[seen.submap].scale, noise) for seen in straight]
    known = [_straightened(prior, bending) for prior in priors]
    agreeing = consistent_priors(known, submap_edges(straight, state, noise)) if known else []
    return solver.solve_sim3(nodes, edges, agreeing, fixed=min(state.map_from_submap))


def _straightened(prior: PosePrior, bending: Bending) -> PosePrior:
    """Return a prior as the cameras that it is known from would give it if the submap were not bent."""
    bent_from_straight = bending.straight_from_bent(prior.submap, prior.middle).inverse()
    return replace(prior, map_from_submap=prior.map_from_submap @ bent_from_straight)


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


def optimise_frames(state: MapState, solver: PoseGraphSolver) -> None:
    """Move only the camera poses (the paper's graph, Eq. 15-16 on SE(3)); cloud and references stay."""
    nodes = {index: state.map_from_cam(index) for index in state.frames}
    if state.frame_edges:
        state.move_frames(solver.solve_se3(nodes, state.frame_edges, fixed=next(iter(state.frames))))
