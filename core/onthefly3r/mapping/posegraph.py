"""Pose graph optimisation (Eq. 15-16): Sim(3) of submaps and frames by default, the paper's SE(3) graph as preset.

Nodes are the submaps and those frames that more than one submap saw. An edge joins a frame to each submap that saw it,
the one that predicted it and those that it was a reference for: the errors of views are independent, whereas relative
poses of submaps that share a reference err together.

The solver sits behind `PoseGraphSolver`, because gtsam has no wheels for Windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..errors import MissingDependencyError
from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, rotation_log, skew
from ..records import Edge, FrameEdge, Sighting
from .state import MapState

HUBER = 1.345  # whitened units
MAX_ITERATIONS = 30
MEDIAN_MISFIT = 6.35  # of a chi-squared variable of seven degrees of freedom
OUTLYING_PRIOR = 10.0  # times the usual squared misfit
ROUNDS = 2  # of solving the graph with the noise that the misfits show
FRAMES = 2**32  # nodes of frames are numbered from here, those of submaps from 0
# Median of the mean square of three standard normal variables, and of the square of one.
MEDIAN_OF_THREE, MEDIAN_OF_ONE = 0.789, 0.455
LEAST_NOISE = 1e-6  # rad, spacings, of the logarithm of scale: rounding is no measure of anything


@dataclass(frozen=True)
class PosePrior:
    """What is known of a submap's pose from outside the map."""

    submap: int
    map_from_submap: Sim3
    information: Float  # (7, 7) of [rotation rad, translation, log scale], right perturbation; may be singular


@dataclass(frozen=True)
class ViewNoise:
    """Standard deviations, per axis, of a view within its local model."""

    rotation_rad: float
    position: float  # of the camera, map units
    log_scale: float


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
    """Move submaps and frames to agree with all sightings and priors (Eq. 16 on Sim(3)); return the largest shift.

    A frame that several submaps saw goes to the mean of what they say, others follow their submap. How well a view is
    known within its local model is not assumed: it is what the misfits show, first as the map is and then as it has
    settled. Priors that contradict their neighbours are left out. The shift is in spacings.
    """
    sightings = shared_sightings(state)
    tree = len(sightings) <= _fitted(sightings)
    if not sightings or (tree and not priors):  # nothing to balance
        return 0.0
    nodes = dict(state.map_from_submap)
    nodes |= {FRAMES + seen.frame: state.submap_pose_of(seen.frame) for seen in sightings}
    before = {index: state.map_from_cam(index).translation for index in state.frames}
    solved = nodes
    for _ in range(ROUNDS):
        noise = view_noise(solved, sightings, LEAST_NOISE * state.spacing)
        edges = [view_edge(seen, state.map_from_submap[seen.submap].scale, noise) for seen in sightings]
        known = consistent_priors(priors, submap_edges(state, noise))
        solved = solver.solve_sim3(solved, edges, known, fixed=0)
    state.move_submaps(
        {node: pose for node, pose in solved.items() if node < FRAMES},
        {node - FRAMES: pose for node, pose in solved.items() if node >= FRAMES},
    )
    shift = max(float(np.abs(state.map_from_cam(i).translation - before[i]).max()) for i in before)
    return shift / state.spacing


def shared_sightings(state: MapState) -> list[Sighting]:
    """Return all sightings of the frames that more than one submap saw, that by their own submap among them."""
    own = {seen.frame: state.frames[seen.frame] for seen in state.sightings}
    first = [Sighting(i, frame.submap, Sim3(), frame.submap_from_cam) for i, frame in own.items()]
    return first + state.sightings


def view_noise(nodes: Mapping[int, Sim3], sightings: Sequence[Sighting], least_position: float) -> ViewNoise:
    """Return what the misfits of the sightings at given poses show of the noise of one view.

    Medians, so that views placed wrong do not count. Where frames and submaps follow few sightings, these fit better
    than they are good: the unknowns' share is added.
    """
    steps = np.array([_misfit_at_camera(nodes, seen) for seen in sightings])
    grow = np.sqrt(len(sightings) / max(len(sightings) - _fitted(sightings), 1))
    rotation, position = (np.sqrt(np.median((steps[:, k : k + 3] ** 2).mean(axis=1)) / MEDIAN_OF_THREE) for k in (0, 3))
    log_scale = np.sqrt(np.median(steps[:, 6] ** 2) / MEDIAN_OF_ONE)
    return ViewNoise(
        rotation_rad=max(float(grow * rotation), LEAST_NOISE),
        position=max(float(grow * position), least_position),
        log_scale=max(float(grow * log_scale), LEAST_NOISE),
    )


def _fitted(sightings: Sequence[Sighting]) -> int:
    """Return how many sightings it takes to fix all frames and submaps that they join to one another."""
    return len({seen.frame for seen in sightings}) + len({seen.submap for seen in sightings}) - 1


def _misfit_at_camera(nodes: Mapping[int, Sim3], seen: Sighting) -> Float:
    """Return [rotation rad, position in map units, log scale] (7,) by which a submap's view misses the frame."""
    submap = nodes[seen.submap]
    frame_from_submap = nodes[FRAMES + seen.frame].inverse() @ submap
    centre = Sim3(1.0, np.eye(3), seen.submap_from_cam.translation)
    step = tangent(centre.inverse() @ seen.frame_from_submap.inverse() @ frame_from_submap @ centre)
    step[3:6] *= submap.scale
    return step


def view_edge(seen: Sighting, scale: float, noise: ViewNoise) -> Edge:
    """Return the edge from a frame to a submap that saw it; `scale` is that of the submap in the map."""
    return Edge(FRAMES + seen.frame, seen.submap, seen.frame_from_submap, _view_covariance(seen, scale, noise))


def submap_edges(state: MapState, noise: ViewNoise) -> list[Edge]:
    """Return, for each frame seen again, the relative pose of its own submap and the one that saw it again."""
    edges = []
    for seen in state.sightings:
        source = state.frames[seen.frame].submap
        # Both views err: as much as two in the target's units.
        covariance = 2.0 * _view_covariance(seen, state.map_from_submap[seen.submap].scale, noise)
        edges.append(Edge(source, seen.submap, seen.frame_from_submap, covariance))
    return edges


def _view_covariance(seen: Sighting, scale: float, noise: ViewNoise) -> Float:
    """Covariance (7, 7) of [rotation, translation, log scale], right perturbation in the submap's frame.

    The camera turns about its own centre c: a point p moves by w x (p - c) + u + lambda (p - c).
    """
    centre = seen.submap_from_cam.translation
    to_origin = np.eye(7)
    to_origin[3:6, :3] = skew(centre)
    to_origin[3:6, 6] = -centre
    sigma = np.array([noise.rotation_rad] * 3 + [noise.position / scale] * 3 + [noise.log_scale])
    return np.asarray((to_origin * sigma**2) @ to_origin.T)


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
