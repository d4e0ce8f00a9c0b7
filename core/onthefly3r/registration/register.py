"""One local model against the map: align, validate, prune, split; the map itself is only read here."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, rotation_angle_deg
from ..options import RegistrationOptions
from ..records import (
    Alignment,
    Correspondences,
    FrameEdge,
    LocalModel,
    LocalView,
    PlacedMap,
    Rejection,
    Sighting,
    Subset,
)
from .align import align
from .geometric import only, prune_references
from .references import correspond
from .validate import (
    DEPTH_TOLERANCE,
    LEAST_MISFIT,
    MISFIT_GATE,
    PoseResidual,
    ReferenceVerdict,
    pose_residuals,
    reference_misfit,
    reference_points_in_map,
    validate_query,
    validate_references,
)

# Motion that an image and the one that arrived before it may have for an edge of continuity.
MAX_TURN_DEG = 45.0
MAX_STEP_RATIO = 4.0  # of the usual step
STEPS_REMEMBERED = 50

PositionCheck = Callable[[int, Float, Mapping[int, Float]], float]


@dataclass(frozen=True)
class Registration:
    """A validated local model: where it goes, and which of its new images may come along."""

    alignment: Alignment
    sightings: tuple[Sighting, ...]
    residuals: tuple[PoseResidual, ...]
    accepted: tuple[int, ...]
    refused: tuple[Rejection, ...]
    pruned: tuple[int, ...]  # references that contradicted the others


def register(
    model: LocalModel,
    subset: Subset,
    state: PlacedMap,
    min_confidence: float,
    options: RegistrationOptions,
    far_from_position: PositionCheck | None = None,
) -> Registration | Rejection:
    """Register a local model to the map (Eq. 10-13 with geometric pruning); a misfit is a `Rejection`.

    A subset without new images tells only where its references lie; a misfit names why each of them did not do.
    `far_from_position` tells how far a new image, by its centre in the map, is from where its position says, over
    what is allowed, given the centres of the references.
    """
    references = {i: state.reference(i) for i in subset.references if i in model.views}
    poses = {i: state.submap_pose_of(i) for i in references}
    map_from_cam = {i: state.map_from_cam(i) for i in references}
    pairs = correspond(model, references, poses, min_confidence)
    placed = tuple(i for i in subset.new if i in model.views)
    if subset.new and not placed:
        told = dict.fromkeys(references, "was placed without it")
        return Rejection(subset.new, "backbone", "no new image could be tied to the subset", {}, told)

    def validate(alignment: Alignment) -> ReferenceVerdict:
        return validate_references(model, alignment, map_from_cam, state.spacing, options)

    if options.validation:
        outcome = prune_references(model, pairs, map_from_cam, options.min_references, validate)
    else:
        aligned = align(pairs, subset.new)
        outcome = aligned if isinstance(aligned, Rejection) else (aligned, validate(aligned))
    if isinstance(outcome, Rejection):
        told = _why_not(subset.references, model, pairs, map_from_cam)
        return Rejection(subset.new, outcome.stage, outcome.reason, outcome.numbers, told)
    alignment, verdict = outcome
    kept = alignment.references
    refused = [
        Rejection((i,), "backbone", "could not be placed in its subset") for i in subset.new if i not in model.views
    ]
    accepted = list(placed)
    if options.validation and options.validate_queries:
        good = {i: references[i] for i in kept}
        map_points = reference_points_in_map(good, poses)
        map_from_local = alignment.map_from_local
        local_from_map = map_from_local.inverse()
        centres = {i: map_from_cam[i].translation for i in kept}
        usual = cache(lambda: reference_misfit(model, local_from_map, good, poses, min_confidence))
        for index in placed:
            view = model.views[index]
            query = validate_query(index, view, local_from_map, map_points, min_confidence, usual)
            numbers = {"overlap_points": float(query.overlap), "agreeing_share": query.agreeing, "misfit": query.misfit}
            reason = query.reason
            if query.passed and far_from_position is not None:
                offset = far_from_position(index, map_from_local.apply(view.local_from_cam.translation), centres)
                reason = "lands far from its position" if offset > 1.0 else ""
                numbers["position_offset"] = offset
            if reason:
                accepted.remove(index)
                refused.append(Rejection((index,), "queries", reason, numbers))
    if subset.new and not accepted:
        first = refused[0]
        return Rejection(subset.new, first.stage, first.reason, first.numbers)
    return Registration(
        alignment=alignment,
        sightings=_sightings(model, pairs, kept, state),
        residuals=verdict.residuals,
        accepted=tuple(accepted),
        refused=tuple(refused),
        pruned=tuple(i for i in references if i not in kept),
    )


def _why_not(
    references: Sequence[int], model: LocalModel, pairs: Correspondences, map_from_cam: Mapping[int, Rigid3]
) -> dict[int, str]:
    """Return, for each reference of a model that did not fit, what came of it."""
    aligned = align(pairs)
    told = {}
    for index in references:
        if index not in model.views:
            told[index] = "shares too little with the others"
        elif not (pairs.reference == index).any():
            told[index] = "has no points in common with the map"
        elif isinstance(aligned, Rejection):
            told[index] = "could not be aligned"
        else:
            (residual,) = pose_residuals(model, aligned.map_from_local, map_from_cam, (index,))
            told[index] = f"is turned by {residual.rotation_deg:.1f} degrees against the map"
    return told


def check_seed(views: Mapping[int, LocalView], min_confidence: float) -> dict[int, Rejection]:
    """Return the views of a first model that contradict the rest, worst first.

    Each is judged by its depth against the points of all views that still count; the worst one is taken out until
    the others agree.
    """
    samples = {i: _sample(view, min_confidence, seed=i) for i, view in views.items()}
    rejected: dict[int, Rejection] = {}
    while len(samples) > 1:
        verdicts = [
            validate_query(
                index,
                views[index],
                Sim3(),
                np.vstack([points for i, points in samples.items() if i != index]),
                min_confidence,
            )
            for index in samples
        ]
        usual = float(np.median([verdict.misfit for verdict in verdicts]))
        worst = max(verdicts, key=lambda verdict: (not verdict.passed, verdict.misfit))
        too_far = worst.misfit > max(LEAST_MISFIT, MISFIT_GATE * usual)
        if worst.passed and not too_far:
            break
        reason = worst.reason or "its depth disagrees with the other images more than theirs does"
        numbers = {"overlap_points": float(worst.overlap), "agreeing_share": worst.agreeing, "misfit": worst.misfit}
        rejected[worst.index] = Rejection((worst.index,), "seed", reason, numbers)
        del samples[worst.index]
    return rejected


def seed_edges(views: Mapping[int, LocalView], accepted: Sequence[int], min_confidence: float) -> tuple[FrameEdge, ...]:
    """Return the edges within the batch (Eq. 15) of a first model, which is the map.

    There is no alignment that could tell their weight: it follows how far the depth of the views misses the points of
    all others, which their poses and depths share.
    """
    samples = {i: _sample(views[i], min_confidence, seed=i) for i in accepted}
    misfits = []
    for index in accepted:
        others = np.vstack([points for i, points in samples.items() if i != index])
        misfits.append(validate_query(index, views[index], Sim3(), others, min_confidence).misfit)
    known = [misfit for misfit in misfits if np.isfinite(misfit)]
    sigma_rad = max(float(np.median(known)) if known else DEPTH_TOLERANCE, 1e-4)
    depths = [views[i].local_from_cam.inverse().apply(points)[:, 2] for i, points in samples.items()]
    sigma = sigma_rad * float(np.median(np.concatenate(depths)))
    poses = {i: views[i].local_from_cam for i in accepted}
    return tuple(
        FrameEdge(a, b, poses[a].inverse() @ poses[b], sigma_rad, sigma, "batch")
        for k, a in enumerate(accepted)
        for b in accepted[k + 1 :]
    )


def _sample(view: LocalView, min_confidence: float, seed: int, count: int = 200) -> np.ndarray:
    points = view.points[(view.confidence >= min_confidence) & np.isfinite(view.points).all(axis=-1)]
    return np.asarray(points[np.random.default_rng(seed).permutation(len(points))[:count]], float)


def _sightings(
    model: LocalModel, pairs: Correspondences, kept: tuple[int, ...], state: PlacedMap
) -> tuple[Sighting, ...]:
    """Return how the next submap sees each kept reference, by the Sim(3) of that one alone."""
    sightings = []
    for index in kept:
        found = align(only(pairs, (index,)))
        if not isinstance(found, Rejection):
            frame_from_submap = state.submap_pose_of(index).inverse() @ found.map_from_local
            sightings.append(Sighting(index, state.next_submap(), frame_from_submap, model.views[index].local_from_cam))
    return tuple(sightings)


def frame_edges(
    model: LocalModel, registration: Registration, retrieved: Mapping[int, Collection[int]], state: PlacedMap
) -> tuple[FrameEdge, ...]:
    """Return the paper's edges (Eq. 15): reference to new image, within the batch, and from the image before in time.

    `retrieved` names the frames of the map that each new image is most like.
    """
    map_from_local = registration.alignment.map_from_local
    doubt = 1.0 + 2.0 * (1.0 - registration.alignment.inlier_ratio)  # weight follows inlier ratio and residual
    sigma_rotation_rad = doubt * max(np.radians(np.median([r.rotation_deg for r in registration.residuals])), 1e-4)
    sigma_translation = doubt * max(registration.alignment.residual, 1e-6 * state.spacing)
    placed = {i: map_from_local.apply_to_pose(view.local_from_cam) for i, view in model.views.items()}

    def edge(source: int, target: int, kind: Literal["ref", "batch", "cont"], start: Rigid3) -> FrameEdge:
        relative = start.inverse() @ placed[target]
        return FrameEdge(source, target, relative, float(sigma_rotation_rad), sigma_translation, kind)

    new = registration.accepted
    edges = [edge(r, q, "ref", placed[r]) for r in registration.alignment.references for q in new]
    edges += [edge(a, b, "batch", placed[a]) for i, a in enumerate(new) for b in new[i + 1 :]]
    longest = MAX_STEP_RATIO * _usual_step(state)
    for q in new:
        if q - 1 in state.frames and q - 1 in retrieved[q]:  # shots are numbered as they arrive
            candidate = edge(q - 1, q, "cont", state.map_from_cam(q - 1))
            turn_deg = rotation_angle_deg(candidate.source_from_target.rotation)
            step = float(np.linalg.norm(candidate.source_from_target.translation))
            if turn_deg <= MAX_TURN_DEG and step <= longest:
                edges.append(candidate)
    return tuple(edges)


def _usual_step(state: PlacedMap) -> float:
    """Return the median distance of images that arrived one after the other, among the frames placed last."""
    pairs = [(i - 1, i) for i in state.last_accepted(STEPS_REMEMBERED) if i - 1 in state.frames]
    steps = [np.linalg.norm(state.map_from_cam(a).translation - state.map_from_cam(b).translation) for a, b in pairs]
    return float(np.median(steps)) if steps else 0.0
