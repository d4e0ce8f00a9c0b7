"""One local model against the map: align, validate, prune, split; the map itself is only read here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..geometry.transforms import Sim3
from ..options import RegistrationOptions
from ..records import (
    Alignment,
    Correspondences,
    Edge,
    FrameEdge,
    LocalModel,
    LocalView,
    Rejection,
    Subset,
)
from ..registration.align import align
from ..registration.geometric import only, prune_references
from ..registration.references import correspond
from ..registration.validate import (
    PoseResidual,
    ReferenceVerdict,
    reference_points_in_map,
    validate_query,
    validate_references,
)
from .state import MapState


@dataclass(frozen=True)
class Registration:
    """A validated local model: where it goes, and which of its new images may come along."""

    alignment: Alignment
    edges: tuple[Edge, ...]
    residuals: tuple[PoseResidual, ...]
    accepted: tuple[int, ...]
    refused: tuple[Rejection, ...]
    pruned: tuple[int, ...]  # references that contradicted the others


def register(
    model: LocalModel,
    subset: Subset,
    state: MapState,
    min_confidence: float,
    options: RegistrationOptions,
) -> Registration | Rejection:
    """Register a local model to the map (Eq. 10-13 with geometric pruning); a misfit is a `Rejection`."""
    references = {i: state.reference(i) for i in subset.references if i in model.views}
    poses = {i: state.submap_pose_of(i) for i in references}
    map_from_cam = {i: state.map_from_cam(i) for i in references}
    pairs = correspond(model, references, poses, min_confidence)
    placed = tuple(i for i in subset.new if i in model.views)
    if not placed:
        return Rejection(subset.new, "backbone", "no new image could be tied to the subset")

    def validate(alignment: Alignment) -> ReferenceVerdict:
        return validate_references(model, alignment, map_from_cam, state.spacing, options)

    if options.validation:
        outcome = prune_references(model, pairs, map_from_cam, options.min_references, validate)
    else:
        aligned = align(pairs, subset.new)
        outcome = aligned if isinstance(aligned, Rejection) else (aligned, validate(aligned))
    if isinstance(outcome, Rejection):
        return Rejection(subset.new, outcome.stage, outcome.reason, outcome.numbers)
    alignment, verdict = outcome
    kept = alignment.references
    refused = [
        Rejection((i,), "backbone", "could not be placed in its subset") for i in subset.new if i not in model.views
    ]
    accepted = list(placed)
    if options.validation and options.validate_queries:
        map_points = reference_points_in_map({i: references[i] for i in kept}, {i: poses[i] for i in kept})
        local_from_map = alignment.map_from_local.inverse()
        for index in placed:
            query = validate_query(index, model.views[index], local_from_map, map_points, min_confidence)
            if not query.passed:
                accepted.remove(index)
                numbers = {"overlap_points": float(query.overlap), "agreeing_share": query.agreeing}
                refused.append(Rejection((index,), "queries", query.reason, numbers))
    if not accepted:
        first = refused[0]
        return Rejection(subset.new, first.stage, first.reason, first.numbers)
    return Registration(
        alignment=alignment,
        edges=_submap_edges(only(pairs, kept), state, alignment.residual),
        residuals=verdict.residuals,
        accepted=tuple(accepted),
        refused=tuple(refused),
        pruned=tuple(i for i in references if i not in kept),
    )


def check_seed(views: Mapping[int, LocalView], min_confidence: float) -> dict[int, Rejection]:
    """Return the views of a first model that contradict the rest: their depth against all other views' points."""
    rejected = {}
    samples = {i: _sample(view, min_confidence, seed=i) for i, view in views.items()}
    for index, view in views.items():
        others = [points for i, points in samples.items() if i != index]
        points = np.vstack(others) if others else np.zeros((0, 3))
        verdict = validate_query(index, view, Sim3(), points, min_confidence)
        if not verdict.passed:
            numbers = {"overlap_points": float(verdict.overlap), "agreeing_share": verdict.agreeing}
            rejected[index] = Rejection((index,), "seed", verdict.reason, numbers)
    return rejected


def _sample(view: LocalView, min_confidence: float, seed: int, count: int = 200) -> np.ndarray:
    points = view.points[(view.confidence >= min_confidence) & np.isfinite(view.points).all(axis=-1)]
    return np.asarray(points[np.random.default_rng(seed).permutation(len(points))[:count]], float)


def _submap_edges(pairs: Correspondences, state: MapState, residual: float) -> tuple[Edge, ...]:
    """One Sim(3) edge to each submap that predicted some of the references; the target is the next submap.

    A single reference fits itself however wrong it is: what all references together miss is its error too.
    """
    target = state.next_submap()
    owner = np.array([state.frames[int(i)].submap for i in pairs.reference], int)
    edges = []
    for source in np.unique(owner):
        members = tuple(int(i) for i in np.unique(pairs.reference[owner == source]))
        found = align(only(pairs, members), least_residual=residual)
        if isinstance(found, Rejection):
            continue
        source_from_map = state.map_from_submap[int(source)].inverse()
        edges.append(Edge(int(source), target, source_from_map @ found.map_from_local, found.covariance))
    return tuple(edges)


def frame_edges(
    model: LocalModel, registration: Registration, previous: int | None, state: MapState
) -> tuple[FrameEdge, ...]:
    """Return the paper's edges (Eq. 15): reference to query, within the batch, and to the frame accepted before."""
    scale = registration.alignment.map_from_local.scale
    doubt = 1.0 + 2.0 * (1.0 - registration.alignment.inlier_ratio)  # weight follows inlier ratio and residual
    sigma_rotation_rad = doubt * max(np.radians(np.median([r.rotation_deg for r in registration.residuals])), 1e-4)
    sigma_translation = doubt * max(registration.alignment.residual, 1e-6 * state.spacing)

    def edge(source: int, target: int, kind: str) -> FrameEdge:
        local = model.views[source].local_from_cam.inverse() @ model.views[target].local_from_cam
        scaled = type(local)(local.rotation, scale * local.translation)
        return FrameEdge(source, target, scaled, float(sigma_rotation_rad), sigma_translation, kind)  # type: ignore[arg-type]

    new = registration.accepted
    edges = [edge(r, q, "ref") for r in registration.alignment.references for q in new]
    edges += [edge(a, b, "batch") for i, a in enumerate(new) for b in new[i + 1 :]]
    if previous is not None and previous in model.views and previous not in registration.alignment.references:
        edges += [edge(previous, q, "cont") for q in new[:1]]
    return tuple(edges)
