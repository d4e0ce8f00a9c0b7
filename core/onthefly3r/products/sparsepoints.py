"""The COLMAP model of a run: its cameras as their files are stored, and the tracks of the adjustment, coloured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..adjust.intersection import Intersected, intersected_tracks
from ..geometry.arrays import Float, UInt8
from ..geometry.orientation import is_turn, stored_camera, stored_pixels, stored_pose
from ..map.state import MapState
from ..map.store import Store
from ..records import Frame, Observations, PlacedCamera, Shot
from .colmap import SparsePoints, write_model
from .exportframe import ExportFrame
from .localframe import local_from_map, write_offset

REFERENCE_POINTS = 200  # of an image without tracks
GREY = 128


def write_colmap(
    folder: Path,
    cameras: list[PlacedCamera],
    state: MapState,
    store: Store,
    shots: Mapping[int, Shot],
    frame: ExportFrame,
) -> None:
    """Write the model with multi-view tracks where features were matched; pixels are those of the files as stored.

    Points of neural local models, which match no features, have the one view that they were predicted from. A file that
    is stored mirrored is no image of a camera: its pixels are those of the upright photograph.
    """
    to_local = local_from_map(frame)
    turned = {i: shots[i].orientation if is_turn(shots[i].orientation) else 1 for i in state.frames}
    stored = [
        replace(
            placed,
            camera=stored_camera(placed.camera, turned[placed.index]),
            world_from_cam=stored_pose(to_local.apply_to_pose(state.map_from_cam(placed.index)), turned[placed.index]),
        )
        for placed in cameras
    ]
    found = intersected_tracks(state, _observed(state, store), shots) or _references(state)
    pixels = found.pixel.copy()
    for index in np.unique(found.image):
        rows, shot = found.image == index, shots[int(index)]
        pixels[rows] = stored_pixels(found.pixel[rows], shot.width_px, shot.height_px, turned[int(index)])
    sparse = SparsePoints(
        points=to_local.apply(found.points),
        rgb=_colours(found, state, store),
        error_px=found.error_px,
        point=found.point,
        image=found.image,
        pixels=pixels,
    )
    write_model(folder, stored, sparse)
    write_offset(folder, frame)


def _references(state: MapState) -> Intersected:
    """Return some compact reference points of every frame, each seen by the image that it belongs to."""
    points, images, pixels = [], [], []
    for index, stored in sorted(state.frames.items()):
        reference = state.reference(index)
        best = np.argsort(-reference.confidence, kind="stable")[:REFERENCE_POINTS]
        points.append(state.submap_pose_of(index).apply(reference.points[best].astype(float)))
        images.append(np.full(len(best), index))
        pixels.append(stored.grid_from_photo.inverse().apply(reference.pixels[best] + 0.5))
    joined = np.vstack(points)
    number = np.arange(len(joined))
    return Intersected(joined, np.zeros(len(joined)), np.concatenate(images), number, np.vstack(pixels))


def _observed(state: MapState, store: Store) -> Iterator[tuple[int, Observations]]:
    """Yield the observations of the submaps of a map, which may be a part of what was stored."""
    return ((number, found) for number, found in store.stream_observations() if number in state.map_from_submap)


def _colours(found: Intersected, state: MapState, store: Store) -> UInt8:
    """Return the mean colour (N, 3) of the pixels that see each point, as far as the point maps have them."""
    total, seen = np.zeros((len(found.points), 3)), np.zeros(len(found.points))
    for stored in store.stream_points():
        rows = np.flatnonzero(found.image == stored.index)
        if not len(rows) or not len(stored.points):
            continue
        frame = state.frames[stored.index]
        picture, known = _picture(frame, stored.points, stored.rgb)
        cell = np.floor(frame.grid_from_photo.apply(found.pixel[rows])).astype(int)
        cell = np.clip(cell, 0, (frame.camera.width - 1, frame.camera.height - 1))
        hit = known[cell[:, 1], cell[:, 0]]
        np.add.at(total, found.point[rows[hit]], picture[cell[hit, 1], cell[hit, 0]])
        np.add.at(seen, found.point[rows[hit]], 1.0)
    mean = total / np.maximum(seen, 1.0)[:, None]
    return np.where(seen[:, None] > 0.0, np.round(mean), GREY).astype(np.uint8)


def _picture(frame: Frame, points: Float, rgb: UInt8) -> tuple[Float, UInt8]:
    """Return the colours of a frame's points as an image (H, W, 3), holes filled from beside, and where it has any."""
    from scipy.ndimage import distance_transform_edt

    height, width = frame.camera.height, frame.camera.width
    pixel = frame.camera.project(frame.submap_from_cam.inverse().apply(points.astype(float)))
    inside = np.isfinite(pixel).all(axis=1) & (pixel >= 0.0).all(axis=1) & (pixel < (width, height)).all(axis=1)
    column, row = np.floor(pixel[inside]).astype(int).T
    picture, known = np.zeros((height, width, 3)), np.zeros((height, width), bool)
    picture[row, column], known[row, column] = rgb[inside], True
    if not known.any():
        return picture, known
    away, nearest = distance_transform_edt(~known, return_indices=True)
    return picture[tuple(nearest)], away <= max(2.0, 0.02 * width)
