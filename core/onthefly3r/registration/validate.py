"""Validation of a registered local model before it may touch the map (Eq. 12-13)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, rotation_angle_deg
from ..options import RegistrationOptions
from ..records import Alignment, CompactReference, LocalModel, LocalView
from .references import MAX_PAIRS_PER_REFERENCE, spread_sample

MIN_OVERLAP_POINTS = 15
DEPTH_TOLERANCE = 0.06  # relative; terrain steps and occlusions exceed it, so only a share must agree
MIN_AGREEING_SHARE = 0.5
# The depth of a new image may miss the map by so many times what the references' own depth misses, and by as much as
# a least amount that is no measure of anything.
MISFIT_GATE = 5.0
LEAST_MISFIT = 0.01


@dataclass(frozen=True)
class PoseResidual:
    """How far a reference camera lands from its place in the map (Eq. 12)."""

    index: int
    translation: float  # e_r^t, map units
    rotation_deg: float  # e_r^R


@dataclass(frozen=True)
class ReferenceVerdict:
    """The outcome of the reference check: empty reason means passed."""

    residuals: tuple[PoseResidual, ...]
    scale_ratio: float  # scale of the alignment over the scale that the reference cameras suggest
    reason: str

    @property
    def passed(self) -> bool:
        """Whether all references agree with the map."""
        return not self.reason


def pose_residuals(
    model: LocalModel, map_from_local: Sim3, map_from_cam: Mapping[int, Rigid3], references: Sequence[int]
) -> tuple[PoseResidual, ...]:
    """Return e_r^t and e_r^R (Eq. 12) of every reference that the model contains."""
    found = []
    for index in references:
        placed = map_from_local.apply_to_pose(model.views[index].local_from_cam)
        stored = map_from_cam[index]
        found.append(
            PoseResidual(
                index,
                float(np.linalg.norm(placed.translation - stored.translation)),
                rotation_angle_deg(placed.rotation @ stored.rotation.T),
            )
        )
    return tuple(found)


def validate_references(
    model: LocalModel,
    alignment: Alignment,
    map_from_cam: Mapping[int, Rigid3],
    spacing: float,
    options: RegistrationOptions,
) -> ReferenceVerdict:
    """Check the reference poses against tau_t = alpha * l_scene (Eq. 13), the rotation gate and the scale."""
    references = alignment.references
    residuals = pose_residuals(model, alignment.map_from_local, map_from_cam, references)
    ratio = _scale_ratio(model, alignment, map_from_cam, references)
    if len(references) < options.min_references:
        return ReferenceVerdict(residuals, ratio, f"only {len(references)} of {options.min_references} references")
    tau_t = options.alpha * spacing  # Eq. 13
    shifted = [r for r in residuals if r.translation > tau_t]
    turned = [r for r in residuals if r.rotation_deg > options.max_rotation_deg]
    median = float(np.median([r.translation for r in residuals]))
    # The floor keeps a very tight group from condemning a reference that is merely a little less tight.
    gate = max(options.reference_gate * median, 0.1 * tau_t) if options.reference_gate else np.inf
    apart = [r for r in residuals if r.translation > gate]
    reason = ""
    if abs(np.log(ratio)) > np.log(options.max_scale_ratio):
        reason = "implausible scale"
    elif shifted:
        reason = f"{len(shifted)} references are shifted"
    elif turned:
        reason = f"{len(turned)} references are rotated"
    elif apart:
        reason = f"{len(apart)} references disagree with the others"
    return ReferenceVerdict(residuals, ratio, reason)


def _scale_ratio(
    model: LocalModel, alignment: Alignment, map_from_cam: Mapping[int, Rigid3], references: Sequence[int]
) -> float:
    """Scale from points over scale from the distances between the reference cameras; 1 when unknown."""
    local = np.array([model.views[i].local_from_cam.translation for i in references])
    mapped = np.array([map_from_cam[i].translation for i in references])
    first, second = np.triu_indices(len(references), 1)
    local_distance = np.linalg.norm(local[first] - local[second], axis=-1)
    map_distance = np.linalg.norm(mapped[first] - mapped[second], axis=-1)
    known = (local_distance > 0) & (map_distance > 0)
    if not known.any():
        return 1.0
    return float(alignment.map_from_local.scale / np.median(map_distance[known] / local_distance[known]))


@dataclass(frozen=True)
class QueryVerdict:
    """How the map's points look from a new image."""

    index: int
    overlap: int  # map points that fall into the image where it has depth
    agreeing: float  # share of them whose depth agrees
    depth_bias: float  # median log ratio, map depth over predicted depth
    misfit: float  # median size of that log ratio
    reason: str

    @property
    def passed(self) -> bool:
        """Whether the new image agrees with the map."""
        return not self.reason


def validate_query(
    index: int,
    view: LocalView,
    local_from_map: Sim3,
    map_points: Float,
    min_confidence: float,
    usual_misfit: Callable[[], float] | None = None,
) -> QueryVerdict:
    """Compare the depth of map points (N, 3), seen from a new image, with the depth that it predicts itself.

    `usual_misfit` returns what views that are known to be right miss; it is asked only where that matters.
    """
    cam_points = view.local_from_cam.inverse().apply(local_from_map.apply(map_points))
    predicted = _predicted_depth(view, cam_points, min_confidence)
    known = np.isfinite(predicted)
    overlap = int(known.sum())
    if overlap < MIN_OVERLAP_POINTS:
        return QueryVerdict(index, overlap, 0.0, 0.0, np.inf, "does not overlap the references")
    log_ratio = np.log(cam_points[known, 2] / predicted[known])
    agreeing = float((np.abs(log_ratio) <= DEPTH_TOLERANCE).mean())
    misfit = float(np.median(np.abs(log_ratio)))
    reason = ""
    if agreeing < MIN_AGREEING_SHARE:
        reason = "its depth disagrees with the map"
    elif usual_misfit is not None and misfit > LEAST_MISFIT and misfit > MISFIT_GATE * usual_misfit():
        reason = "its depth disagrees with the map more than the references' does"
    return QueryVerdict(index, overlap, agreeing, float(np.median(log_ratio)), misfit, reason)


def reference_misfit(
    model: LocalModel,
    local_from_map: Sim3,
    references: Mapping[int, CompactReference],
    map_from_submap: Mapping[int, Sim3],
    min_confidence: float,
) -> float:
    """Return the median misfit of the references' depth to each other's points; infinite when nothing overlaps."""
    misfits = []
    for index in references:
        others = {i: reference for i, reference in references.items() if i != index}
        points = reference_points_in_map(others, map_from_submap)
        misfits.append(validate_query(index, model.views[index], local_from_map, points, min_confidence).misfit)
    return float(np.median(misfits)) if misfits else np.inf


def _predicted_depth(view: LocalView, cam_points: Float, min_confidence: float) -> Float:
    """Depth (N,) that the view's point map has where points in its camera frame project, NaN where nothing is known."""
    pixels = view.camera.project(cam_points)
    height, width = view.confidence.shape
    # Comparisons with the NaN of points behind the camera are false.
    inside = np.flatnonzero(((pixels >= 0) & (pixels < (width, height))).all(axis=-1))
    columns, rows = pixels[inside].astype(int).T
    trusted = view.confidence[rows, columns] >= min_confidence
    own = view.local_from_cam.inverse().apply(view.points[rows, columns].astype(float))[:, 2]
    depth = np.full(len(cam_points), np.nan)
    depth[inside] = np.where(trusted & (own > 0), own, np.nan)
    return depth


def reference_points_in_map(references: Mapping[int, CompactReference], map_from_submap: Mapping[int, Sim3]) -> Float:
    """Return stored points (N, 3) of some references in the map frame, at most `MAX_PAIRS_PER_REFERENCE` of each."""
    parts = []
    for index, reference in references.items():
        kept = spread_sample(np.arange(len(reference.points)), MAX_PAIRS_PER_REFERENCE)
        parts.append(map_from_submap[index].apply(reference.points[kept].astype(float)))
    return np.vstack(parts) if parts else np.zeros((0, 3))
