"""One adjustment of everything: tracks, intrinsics, camera positions, the level and ground control.

The map is first adjusted to its tracks alone, which settles intrinsics and drift. Then it is brought to local
east-north-up by positions or control, and adjusted again together with them, each with its standard deviation. The
result is kept only where the tracks agree to it about as well as before.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..adjust.bundle import Bundle, State
from ..adjust.deviations import camera_deviations
from ..adjust.evidence import Calibrated, intersect, settled
from ..adjust.refine import Block, Refinement, block_of, calibrated, median_error_px, refinement
from ..adjust.ties import LEVER
from ..errors import GeoreferenceError
from ..geometry.arrays import Float
from ..geometry.transforms import Sim3
from ..map.state import MapState
from ..options import Options
from ..records import CameraDeviation, EarthTie, Observations, Shot
from .block_start import BlockStart, ControlPoints, control_start, positions_start, vertical_of
from .control import Control
from .control_file import control_of
from .control_marks import MARK_SIGMA_PX
from .control_residuals import control_residuals
from .ground import ground_normal
from .knowledge import block_ties

ROUNDS = 2
WORSE = 1.05  # times the median reprojection error before: more, and positions or control are not followed
BLUNDER_SIGMAS = 5.0
BLUNDER_ROUNDS = 3


@dataclass(frozen=True)
class Adjusted:
    """What the adjustment found: refined frames and intrinsics, and how the map lies on the Earth where it tells."""

    refinement: Refinement
    tie: EarthTie | None
    warnings: tuple[str, ...]


def adjust_block(
    state: MapState,
    observed: Iterable[tuple[int, Observations]],
    shots: Mapping[int, Shot],
    options: Options,
) -> Adjusted | None:
    """Adjust a map to its tracks and to everything that is known about where it is; None where nothing settles.

    The map is only read. Without positions and control, the refinement alone comes back. Raises `InputError` for a
    control file that cannot be read.
    """
    control = control_of(options.georeference)
    block = block_of(state, observed, shots)
    solved = None if block is None else calibrated(block, options.backbone.principal_point)
    if block is None or solved is None:
        if control is None:
            return None
        why = "control: is left out, because the local models brought no tracks to adjust it with"
        return Adjusted(Refinement({}, {}, {}), None, (why,))
    joint = options.georeference.gps == "adjust"
    start, warnings = positions_start(block, solved, shots, options, ground_normal(state))
    points = None
    if control is not None:
        try:
            start, points, told = control_start(block, solved, shots, options, control, start)
            warnings += told
        except GeoreferenceError as error:
            if start is None:
                return Adjusted(refinement(block, solved, state), None, (f"control: {error}",))
            warnings.append(f"control: {error}; the map is tied to positions alone")
    if start is None or not (joint or points):
        return Adjusted(refinement(block, solved, state), None, tuple(warnings))
    return _joint(block, solved, state, shots, options, control, start, points, warnings)


def _joint(
    block: Block,
    solved: Calibrated,
    state: MapState,
    shots: Mapping[int, Shot],
    options: Options,
    control: Control | None,
    start: BlockStart,
    points: ControlPoints | None,
    warnings: list[str],
) -> Adjusted:
    before = median_error_px(solved.bundle, solved.state)
    for _ in range(BLUNDER_ROUNDS):
        bundle, enu = _tied(block, solved, start, points)
        try:
            adjusted, _ = settled(bundle, enu, ROUNDS)
            after = median_error_px(solved.bundle, _of_tracks(adjusted, solved.state))
        except (np.linalg.LinAlgError, RuntimeError):
            after = np.inf
        if not after <= WORSE * before:
            break
        wrong = _blunders(adjusted, bundle, points)
        if points is None or not wrong:
            break
        warnings += [
            f"control: {label} is {off:.2f} m off and is left out: wrong mark or wrong coordinates"
            for label, off in wrong
        ]
        points = _without(points, [label for label, _ in wrong])
    if not after <= WORSE * before:
        warnings.append(
            "positions and control do not agree with the tracks of the photographs: they place the map and do not "
            f"bend it (reprojection error {before:.2f} px)"
        )
        bundle, adjusted = _tied(block, solved, start, points)
    noise_px = bundle.noise_px(adjusted)
    normal = bundle.normal_equations(adjusted, noise_px)
    deviations = camera_deviations(normal)
    map_from_enu = start.enu_from_map.inverse()
    back = _transformed(_of_tracks(adjusted, solved.state), map_from_enu)
    final = replace(solved, state=replace(back, biases=np.zeros(0)), bundle=replace(solved.bundle))
    found = refinement(block, final, state)
    residuals = (
        ()
        if control is None or points is None
        else control_residuals(
            control,
            points.labels,
            points.marks,
            block.images,
            bundle,
            adjusted,
            normal,
            noise_px,
            start.frame,
            vertical_of(control, start.positions, options),
        )
    )
    notes: dict[str, Any] = {**found.notes, **_notes(bundle, adjusted, deviations)}
    tie = EarthTie(
        enu_from_map=start.enu_from_map,
        origin_lat_deg=start.frame.lat_deg,
        origin_lon_deg=start.frame.lon_deg,
        origin_height_m=start.frame.height_m,
        by_control=points is not None and len(points.labels) > 0,
        crs=control.crs if control is not None else None,
        vertical=vertical_of(control, start.positions, options),
        deviations={
            index: CameraDeviation(float(np.hypot(row[3], row[4]) / np.sqrt(2.0)), float(row[5]), *_degrees(row))
            for index, row in zip(block.images, deviations, strict=True)
        },
        control=residuals,
        warnings=tuple(warnings),
    )
    return Adjusted(replace(found, notes=notes), tie, tuple(warnings))


def _degrees(row: Float) -> tuple[float]:
    return (float(np.degrees(np.sqrt(np.mean(row[:3] ** 2)))),)


def _notes(bundle: Bundle, adjusted: State, deviations: Float) -> dict[str, Any]:
    ties = bundle.ties
    notes: dict[str, Any] = {
        "median_camera_sigma_m": [float(v) for v in np.median(deviations[:, 3:], axis=0)],
        "pixel_noise_px": bundle.noise_px(adjusted),
    }
    if ties is not None:
        flights = adjusted.biases[:-LEVER].reshape(-1, 3)
        if ties.bias_sigma[:-LEVER].any():
            notes["position_bias_m"] = flights.tolist()
        if ties.bias_sigma[-LEVER:].any():
            notes["lever_arm_m"] = adjusted.biases[-LEVER:].tolist()
    return notes


def _tied(block: Block, solved: Calibrated, start: BlockStart, points: ControlPoints | None) -> tuple[Bundle, State]:
    """Return the bundle in local east-north-up with its ties and the marks of control, and where it starts."""
    enu = _transformed(solved.state, start.enu_from_map)
    n = len(enu.points)
    none = np.zeros((0, 3))
    control_m, control_sigma_m = (none, none) if points is None else (points.enu_m, points.sigma_m)
    ties = block_ties(
        block.images,
        solved.state.rotations,
        start.positions,
        start.fitted,
        start.witnesses,
        start.up,
        control_m,
        control_sigma_m,
        n,
    )
    bundle = replace(solved.bundle, ties=ties)
    if points is not None and points.labels:
        bundle, enu = _with_marks(bundle, enu, points, solved.noise_px)
    return bundle, replace(enu, biases=np.zeros(len(ties.bias_sigma)))


def _with_marks(bundle: Bundle, state: State, points: ControlPoints, noise_px: float) -> tuple[Bundle, State]:
    """Return bundle and state with the control points as further points, their marks as observations."""
    n = len(state.points)
    number = {label: k for k, label in enumerate(points.labels)}
    rows = [k for k, label in enumerate(points.marks.label) if label in number]
    rows.sort(key=lambda k: number[points.marks.label[k]])
    marked = np.array([number[points.marks.label[k]] for k in rows], int)
    spread = np.ones(len(bundle.point)) * bundle.spread
    extended = replace(
        bundle,
        image=np.append(bundle.image, points.marks.image[rows]),
        point=np.append(bundle.point, n + marked),
        pixel=np.vstack([bundle.pixel, points.marks.pixel[rows]]),
        weight=np.append(bundle.weight, np.ones(len(rows))),
        spread=np.append(spread, np.full(len(rows), MARK_SIGMA_PX / noise_px)),
    )
    return extended, replace(state, points=np.vstack([state.points, points.enu_m]))


def _blunders(adjusted: State, bundle: Bundle, points: ControlPoints | None) -> list[tuple[str, float]]:
    """Return the worst control point that the rest of the block contradicts, with its distance in metres."""
    if points is None or len(points.labels) < 4:
        return []
    own = adjusted.points[-len(points.labels) :]
    off = points.enu_m - own
    ratio = np.abs(off / points.sigma_m)
    usual = max(1.0, 1.4826 * float(np.median(ratio)))
    worst = int(np.argmax(ratio.max(axis=1)))
    if ratio[worst].max() <= BLUNDER_SIGMAS * usual:
        return []
    alone = _free_of_control(adjusted, bundle, points, worst)
    return [(points.labels[worst], float(np.linalg.norm(np.where(np.isfinite(ratio[worst]), alone, 0.0))))]


def _free_of_control(adjusted: State, bundle: Bundle, points: ControlPoints, k: int) -> Float:
    """Return control minus what its marks alone say where the point lies (3,)."""
    free = intersect(replace(bundle, ties=None), adjusted)
    return np.asarray(points.enu_m[k] - free.points[len(free.points) - len(points.labels) + k])


def _without(points: ControlPoints, labels: Sequence[str]) -> ControlPoints:
    keep = np.array([label not in labels for label in points.labels])
    kept = tuple(label for label in points.labels if label not in labels)
    return replace(points, labels=kept, enu_m=points.enu_m[keep], sigma_m=points.sigma_m[keep])


def _of_tracks(adjusted: State, like: State) -> State:
    return replace(adjusted, points=adjusted.points[: len(like.points)])


def _transformed(state: State, target_from_source: Sim3) -> State:
    return replace(
        state,
        rotations=target_from_source.rotation @ state.rotations,
        centres=target_from_source.apply(state.centres),
        points=target_from_source.apply(state.points),
    )
