"""What the adjusted block says of control and checkpoints: residuals, and how well each point is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..adjust.bundle import Bundle, State
from ..adjust.deviations import propagated
from ..adjust.intrinsics import PARAMETERS, projection_jacobians
from ..adjust.normal_equations import NormalEquations
from ..geometry.arrays import Float
from ..geometry.geodesy import EnuFrame, undulation_m
from ..geometry.transforms import Rigid3
from ..records import ControlResidual
from .control import Control
from .control_marks import MARK_SIGMA_PX, PlacedMarks, triangulated


def control_residuals(
    control: Control,
    used: Sequence[str],
    marks: PlacedMarks,
    images: Sequence[int],
    bundle: Bundle,
    adjusted: State,
    normal: NormalEquations,
    noise_px: float,
    frame: EnuFrame,
    vertical: str,
) -> tuple[ControlResidual, ...]:
    """Return the residual of every marked point: where the marks meet in the adjusted cameras minus its coordinates.

    Standard deviations are those of the place found: marks, cameras and frame together.
    """
    cameras = [bundle.camera(key, adjusted) for key in bundle.keys]
    solver = normal.covariance_solver()
    found = []
    for label in sorted(set(marks.label)):
        rows, point = marks.of(label), control.points[label]
        if len(rows) < 2:
            continue
        seen = marks.image[rows]
        poses = [Rigid3(adjusted.rotations[k], adjusted.centres[k]) for k in seen]
        try:
            place, misfit, own = triangulated(marks.pixel[rows], poses, [cameras[k] for k in seen])
        except ValueError:
            continue
        lat, lon = np.array(point.lat_deg), np.array(point.lon_deg)
        height = frame.height_m if point.height_m is None else point.height_m + float(undulation_m(vertical, lat, lon))
        enu = frame.from_geographic(np.array([point.lat_deg, point.lon_deg, height]))
        jacobian = _by_cameras(place, own, seen.tolist(), bundle, adjusted, len(normal.c))
        covariance = MARK_SIGMA_PX**2 * own + propagated(normal, solver, jacobian)
        east, north, up = (float(v) for v in place - enu)
        found.append(
            ControlResidual(
                label=label,
                role="checkpoint" if point.checkpoint else "control" if label in used else "left out",
                images=len(rows),
                east_m=east,
                north_m=north,
                up_m=float("nan") if point.height_m is None else up,
                sigma_h_m=float(np.sqrt(np.trace(covariance[:2, :2]) / 2.0)),
                sigma_v_m=float(np.sqrt(covariance[2, 2])),
                marks_px=float(np.sqrt(np.mean(misfit**2))),
                enu_m=(float(enu[0]), float(enu[1]), float(enu[2])),
            )
        )
    return tuple(found)


def _by_cameras(
    place: Float, covariance: Float, rows: Sequence[int], bundle: Bundle, adjusted: State, unknowns: int
) -> Float:
    """Return the derivative (3, D) of where marks meet by the unknowns of C: -(J'J)^-1 J' d pixel / d unknowns."""
    total = np.zeros((3, unknowns))
    first = 6 * len(bundle.keys)
    adjustable = np.broadcast_to(bundle.adjustable, (len(bundle.free), len(PARAMETERS)))
    for row in rows:
        key = bundle.keys[row]
        seen = adjusted.rotations[row].T @ (place - adjusted.centres[row])
        by_seen, by_lens = (part[0] for part in projection_jacobians(bundle.camera(key, adjusted), seen[None]))
        by_point = by_seen @ adjusted.rotations[row].T
        gain = -covariance @ by_point.T
        total[:, 6 * row : 6 * row + 3] += gain @ np.cross(by_seen, seen[None])
        total[:, 6 * row + 3 : 6 * row + 6] -= gain @ by_point
        if key in bundle.free:
            k = bundle.free.index(key)
            columns = slice(first + k * len(PARAMETERS), first + (k + 1) * len(PARAMETERS))
            total[:, columns] += gain @ (by_lens * adjustable[k])
    return total
