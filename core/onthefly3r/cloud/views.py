"""The placed photographs as the dense stages see them: final cameras in local metres, and points that they see.

A depth map lives in a pinhole camera of its own, the `grid`, so that a pixel and its depth lead to another photograph
by a matrix; the photographs themselves keep their distortion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.arrays import Float
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3, Sim3
from ..map.state import MapState
from ..records import Shot

MAX_WIDENING = 1.2  # of the grid over the photograph, where the lens bends the view outwards
BORDER_SAMPLES = 16
POINTS_PER_VIEW = 500


@dataclass(frozen=True)
class View:
    """One placed photograph."""

    shot: Shot
    batch: int  # number of the submap that placed it
    camera: Camera  # of the photograph as it is read, with distortion
    grid: Camera  # of the depth map, without distortion, at the same pose
    level_from_cam: Rigid3  # metres, or units of the levelled map
    points: Float  # (N, 3) float32 level frame, some that it sees

    @property
    def distance(self) -> float:
        """Median distance of its points along the optical axis; NaN without points."""
        if not len(self.points):
            return float("nan")
        return float(np.median((self.points - self.level_from_cam.translation) @ self.level_from_cam.rotation[:, 2]))

    @property
    def gsd(self) -> float:
        """Ground sampling distance of the depth map."""
        return self.distance / self.grid.fx


def photograph_camera(index: int, state: MapState, shot: Shot) -> Camera:
    """Return the final intrinsics of a placed photograph, at its own size."""
    frame = state.frames[index]
    known = state.calibrations.get(shot.camera_key)
    return known or frame.camera.through(frame.grid_from_photo.inverse(), shot.width_px, shot.height_px)


def placed_views(state: MapState, shots: Mapping[int, Shot], level_from_map: Sim3, longest_px: int) -> dict[int, View]:
    """Return the placed photographs by shot index, reduced to `longest_px`, in the order of their acceptance."""
    views = {}
    for index in state.frames:
        shot = shots[index]
        factor = min(1.0, longest_px / max(shot.width_px, shot.height_px))
        size = max(1, round(shot.width_px * factor)), max(1, round(shot.height_px * factor))
        views[index] = _view(index, state, shot, size, level_from_map, state.map_from_cam(index))
    return views


def point_views(state: MapState, shots: Mapping[int, Shot], level_from_map: Sim3) -> dict[int, View]:
    """Return the same at the size of the point maps that the map was built with, and where their points lie."""
    views = {}
    for index, frame in state.frames.items():
        size = frame.camera.width, frame.camera.height
        map_from_cam = state.submap_pose_of(index).apply_to_pose(frame.submap_from_cam)
        views[index] = _view(index, state, shots[index], size, level_from_map, map_from_cam)
    return views


def _view(
    index: int, state: MapState, shot: Shot, size: tuple[int, int], level_from_map: Sim3, map_from_cam: Rigid3
) -> View:
    camera = photograph_camera(index, state, shot).resized(*size)
    reference = state.reference(index)
    step = max(1, len(reference.points) // POINTS_PER_VIEW)
    points = (level_from_map @ state.submap_pose_of(index)).apply(reference.points[::step].astype(float))
    return View(
        shot=shot,
        batch=state.frames[index].submap,
        camera=camera,
        grid=pinhole(camera),
        level_from_cam=level_from_map.apply_to_pose(map_from_cam),
        points=points.astype(np.float32),
    )


def pinhole(camera: Camera) -> Camera:
    """Return a camera without distortion and with square pixels that sees all that the given one sees."""
    if not any(camera.distortion) and camera.fx == camera.fy:
        return camera
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    ends = np.stack(np.meshgrid(along, along), axis=-1)
    border = ends[(ends == 0.0).any(axis=-1) | (ends == 1.0).any(axis=-1)] * (camera.width, camera.height)
    focal = 0.5 * (camera.fx + camera.fy)
    xy = focal * camera.rays(border)[:, :2]
    middle = np.array([camera.width / 2 - camera.cx, camera.height / 2 - camera.cy])
    reach = 0.5 * MAX_WIDENING * np.array([camera.width, camera.height])
    low = np.floor(np.maximum(np.nan_to_num(xy.min(axis=0), nan=-np.inf), middle - reach))
    high = np.ceil(np.minimum(np.nan_to_num(xy.max(axis=0), nan=np.inf), middle + reach))
    width, height = (int(side) for side in np.maximum(high - low, 1))
    return replace(
        camera,
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=-float(low[0]),
        cy=-float(low[1]),
        distortion=(0.0, 0.0, 0.0, 0.0),
    )


@dataclass(frozen=True)
class PixelTransfer:
    """Where the pixels of one depth map lie in another: the pixel of (x, y, 1) at depth d is at d * A (x, y, 1) + b."""

    matrix: Float  # (3, 3) A
    offset: Float  # (3,) b

    @classmethod
    def between(cls, source: View, target: View) -> PixelTransfer:
        """Return the transfer from the grid of one view to that of another; the third coordinate is the depth there."""
        to_pixels = target.grid.matrix() @ target.level_from_cam.rotation.T
        rotation = to_pixels @ source.level_from_cam.rotation
        shift = source.level_from_cam.translation - target.level_from_cam.translation
        return cls(rotation @ np.linalg.inv(source.grid.matrix()), to_pixels @ shift)
