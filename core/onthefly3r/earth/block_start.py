"""How a block lies on the Earth before it is adjusted to what is known there: by its positions, or its control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..adjust.bundle import State
from ..adjust.evidence import Calibrated
from ..adjust.refine import Block
from ..errors import GeoreferenceError
from ..geometry.arrays import Float, Int
from ..geometry.geodesy import EnuFrame, undulation_m
from ..geometry.transforms import Rigid3, Sim3
from ..options import Options
from ..records import Shot
from .control import Control
from .control_fit import control_similarity, exchanged_axes, is_poor, scatter_warning
from .control_marks import PlacedMarks, placed_marks, triangulated, wrong_marks
from .georef import georeference, levelled
from .levelfit import LevelFit
from .positions import Positions, usable_positions
from .updirection import UpWitness

FAR_KM = 20.0
LOOKS_UP = 0.3  # upward part of the mean view


@dataclass(frozen=True)
class BlockStart:
    """How the block lies on the Earth before the joint adjustment."""

    enu_from_map: Sim3
    frame: EnuFrame
    positions: Positions | None = None
    fitted: LevelFit | None = None
    witnesses: tuple[UpWitness, ...] = ()
    up: Float | None = None


@dataclass(frozen=True)
class ControlPoints:
    """Control that takes part: labels, coordinates (K, 3), sigmas (K, 3), and all marks that are believed."""

    labels: tuple[str, ...]
    enu_m: Float
    sigma_m: Float
    marks: PlacedMarks


def positions_start(
    block: Block, solved: Calibrated, shots: Mapping[int, Shot], options: Options, normal: Float | None
) -> tuple[BlockStart | None, list[str]]:
    """Return the start on positions, None where they do not tie the map to the Earth, and warnings."""
    poses = _poses(block, solved.state)
    try:
        georeference(poses, shots, options.georeference, normal)
    except GeoreferenceError:
        return None, []
    positions = usable_positions(sorted(poses), shots, options.georeference)
    centres = np.array([poses[i].translation for i in positions.images])
    fitted, witnesses, _ = levelled(poses, shots, centres, positions, normal, 0)
    up = fitted.enu_from_map.rotation[2]
    return BlockStart(fitted.enu_from_map, positions.frame, positions, fitted, tuple(witnesses), up), []


def control_start(
    block: Block,
    solved: Calibrated,
    shots: Mapping[int, Shot],
    options: Options,
    control: Control,
    start: BlockStart | None,
) -> tuple[BlockStart, ControlPoints, list[str]]:
    """Return the start on control, where there are three points or more, and the control that takes part."""
    pose_of = _poses(block, solved.state)
    poses = [pose_of[i] for i in block.images]
    cameras = [solved.bundle.camera(key, solved.state) for key in solved.bundle.keys]
    marks = placed_marks(control, block.images, shots, poses, cameras)
    told = list(marks.warnings)
    wrong, said = wrong_marks(marks, poses, cameras)
    marks, told = marks.without(wrong), told + said
    frame = start.frame if start is not None else _frame_of(control)
    vertical = vertical_of(control, start.positions if start else None, options)
    labels, seen = [], []
    for label in sorted(set(marks.label)):
        rows = marks.of(label)
        if len(rows) < 2 or control.points[label].checkpoint:
            continue
        try:
            seen.append(_seen(rows, marks, poses, cameras))
            labels.append(label)
        except ValueError as error:
            told.append(f"control: {label} is left out: {error}")
    enu, sigma = control_enu(control, labels, frame, vertical)
    map_points = np.array(seen).reshape(-1, 3)
    if start is not None and len(labels):
        _require_near(control, enu, start, map_points)
    high = np.isfinite(sigma[:, 2])
    if high.sum() >= 3 or start is None:
        if exchanged_axes(map_points[high], enu[high], sigma[high]):
            raise GeoreferenceError(
                f"{control.path} fits only as a mirror image: its x and y are exchanged; exchange the columns"
            )
        try:
            similarity, good, scatter = control_similarity(map_points[high], enu[high], sigma[high])
        except GeoreferenceError:
            if start is None:
                raise
        else:
            _require_upright(control, similarity, poses)
            off = np.linalg.norm(enu[high] - similarity.apply(map_points[high]), axis=1)
            bad = [labels[k] for k in np.flatnonzero(high)[~good]]
            told += [
                f"control: {label} is {distance:.2f} m off the other points and is left out: wrong mark or coordinates"
                for label, distance in zip(bad, off[~good], strict=True)
            ]
            poor = is_poor(scatter, enu, sigma)
            told += scatter_warning(labels, scatter, sigma) if poor else []
            keep = np.array([label not in bad for label in labels])
            labels = [label for label in labels if label not in bad]
            enu, sigma = enu[keep], sigma[keep] * (scatter if poor else 1.0)
            start = replace(start, enu_from_map=similarity) if start else BlockStart(similarity, frame)
    if start is None:
        raise GeoreferenceError("no control point has a height")
    return start, ControlPoints(tuple(labels), enu, sigma, marks), told


def vertical_of(control: Control | None, positions: Positions | None, options: Options) -> Any:
    """Return the vertical reference of the result: the option's, that of the positions, or none that is known."""
    if options.georeference.vertical != "auto":
        return options.georeference.vertical
    return "unknown" if positions is None else positions.vertical


def control_enu(control: Control, labels: Sequence[str], frame: EnuFrame, vertical: str) -> tuple[Float, Float]:
    """Return points in local east-north-up (K, 3) and their standard deviations (K, 3), infinite without height."""
    points = [control.points[label] for label in labels]
    lat, lon = np.array([p.lat_deg for p in points]), np.array([p.lon_deg for p in points])
    height = np.array([np.nan if p.height_m is None else p.height_m for p in points])
    ellipsoidal = np.where(np.isnan(height), frame.height_m, height + undulation_m(vertical, lat, lon))
    enu = frame.from_geographic(np.stack([lat, lon, ellipsoidal], axis=-1).reshape(-1, 3))
    sigma = np.array([(p.sigma_h_m, p.sigma_h_m, p.sigma_v_m) for p in points]).reshape(-1, 3)
    sigma[np.isnan(height), 2] = np.inf
    return enu, sigma


def _require_upright(control: Control, enu_from_map: Sim3, poses: Sequence[Rigid3]) -> None:
    """Raise where cameras would look up from below the ground: over flat ground, that is what a mirror image fits."""
    view = enu_from_map.rotation @ np.mean([pose.rotation[:, 2] for pose in poses], axis=0)
    if view[2] > LOOKS_UP:
        raise GeoreferenceError(
            f"{control.path} fits only with the cameras below the ground, which is a mirror image: its x and y are "
            "exchanged; exchange the columns"
        )


def _require_near(control: Control, enu: Float, start: BlockStart, map_points: Float) -> None:
    """Raise where control lies nowhere near the photographs, and say what would bring it there."""
    away = float(np.median(np.linalg.norm((enu - start.enu_from_map.apply(map_points))[:, :2], axis=1))) / 1000.0
    if away <= FAR_KM:
        return
    first = next(iter(control.points.values()))
    hint = "is it another CRS, or are the axes exchanged?"
    if abs(first.given[0]) <= 90.0 and abs(first.given[1]) <= 180.0:
        swapped = start.frame.from_geographic(np.array([[first.given[0], first.given[1], start.frame.height_m]]))
        if np.linalg.norm(swapped[0, :2]) < 1000.0 * FAR_KM:
            hint = "longitude and latitude are exchanged; exchange the columns"
    raise GeoreferenceError(f"{control.path} lies {away:,.0f} km from the photographs' positions: {hint}")


def _seen(rows: Int, marks: PlacedMarks, poses: Sequence[Rigid3], cameras: Sequence[Any]) -> Float:
    images = marks.image[rows]
    return triangulated(marks.pixel[rows], [poses[k] for k in images], [cameras[k] for k in images])[0]


def _frame_of(control: Control) -> EnuFrame:
    points = list(control.points.values())
    heights = [p.height_m for p in points if p.height_m is not None]
    return EnuFrame(
        float(np.median([p.lat_deg for p in points])),
        float(np.median([p.lon_deg for p in points])),
        float(np.median(heights)) if heights else 0.0,
    )


def _poses(block: Block, state: State) -> dict[int, Rigid3]:
    return {i: Rigid3(r, c) for i, r, c in zip(block.images, state.rotations, state.centres, strict=True)}
