"""The photographs of a run as the files tell them: placed cameras, rows of the tables, footprints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..earth.positions import usable_positions
from ..geometry.geodesy import WorldFrame
from ..map.state import MapState
from ..options import Options
from ..records import GeoReference, PlacedCamera, Rejection, Shot
from .exportframe import ExportFrame
from .footprints import Footprint, footprint, with_overlap
from .rows import CameraRow, placed_row, rejected_row


def placed_cameras(
    state: MapState, shots: Mapping[int, Shot], retries: Mapping[int, int], frame: ExportFrame
) -> list[PlacedCamera]:
    """Return the accepted cameras in the export frame, at photograph size, in the order of the shots."""
    placed = []
    part_of = {i: part for part, frames in enumerate(state.fragments().values(), start=1) for i in frames}
    for index in sorted(state.frames):
        shot, stored = shots[index], state.frames[index]
        placed.append(
            PlacedCamera(
                index=index,
                name=shot.name,
                camera=state.calibrations.get(shot.camera_key)
                or stored.camera.through(stored.grid_from_photo.inverse(), shot.width_px, shot.height_px),
                world_from_cam=frame.pose(state.map_from_cam(index)),
                batch=stored.submap,
                retries=retries.get(index, 0),
                part=part_of[index],
            )
        )
    return placed


def footprints(cameras: list[PlacedCamera], state: MapState, frame: ExportFrame) -> list[Footprint]:
    """Return what the cameras cover, each on the plane at the median height of the points that it sees."""
    found = []
    for camera in cameras:
        points = state.submap_pose_of(camera.index).apply(state.reference(camera.index).points.astype(float))
        if len(points):
            found.append(footprint(camera, float(np.median(frame.points(points)[:, 2]))))
    return with_overlap([item for item in found if item is not None])


def camera_rows(
    cameras: list[PlacedCamera],
    state: MapState,
    shots: Mapping[int, Shot],
    rejections: Mapping[int, Rejection],
    retries: Mapping[int, int],
    reference: GeoReference | None,
    frame: ExportFrame,
    options: Options,
) -> list[CameraRow]:
    """Return one row per photograph, placed ones first, both in capture order, whatever order the shots came in.

    Tagged positions are in the export frame.
    """
    tagged = _tagged_positions(shots, frame, options) if reference else {}
    rows = []
    for camera in sorted(cameras, key=lambda camera: shots[camera.index].capture_order):
        position, sigma_h_m, sigma_v_m = tagged.get(camera.index, (None, None, None))
        row = placed_row(
            camera,
            shots[camera.index],
            gps=position,
            sigma_h_m=sigma_h_m,
            sigma_v_m=sigma_v_m,
            used=bool(reference and camera.index in reference.residuals_m),
            convergence_deg=frame.convergence_deg(state.map_from_cam(camera.index)),
        )
        known = reference.deviations.get(camera.index) if reference else None
        rows.append(replace(row, sd_h=known.h_m, sd_v=known.v_m, sd_deg=known.angle_deg) if known else row)
    for index in sorted(rejections, key=lambda index: shots[index].capture_order):
        position = tagged.get(index, (None,))[0]
        reason, tries = rejections[index].reason, retries.get(index, 0)
        rows.append(rejected_row(shots[index], index + 1, reason, gps=position, retries=tries))
    return rows


Tagged = tuple[tuple[float, float, float], float, float]  # position in the export frame, sigmas in m


def _tagged_positions(shots: Mapping[int, Shot], frame: ExportFrame, options: Options) -> dict[int, Tagged]:
    positions = usable_positions(sorted(shots), shots, options.georeference)
    if frame.world is None or not positions.images:
        return {}
    world = WorldFrame(frame.world.crs, frame.world.vertical, positions.frame).from_enu(positions.enu)
    return {
        index: ((float(x), float(y), float(z)), float(h), float(v))
        for index, (x, y, z), h, v in zip(
            positions.images, world, positions.sigma_h_m, positions.sigma_v_m, strict=True
        )
    }
