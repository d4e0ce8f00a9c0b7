"""Depths that the adjustment's tracks give the photographs: what pins the first pass's maps to the final cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..adjust.tracks import Tracks, chosen_tracks, joined_tracks
from ..geometry.arrays import Bool, Float
from ..map.state import MapState
from ..map.store import Store
from .alignment import TRACK_REACH, DepthTies
from .views import View

MOST_ERROR = 2.5e-3  # of the longest side: a track that misses its pixel by more is a mismatch
LEAST_ANGLE_DEG = 3.0  # between the outermost rays of a track, about


def track_ties(
    state: MapState, store: Store, views: Mapping[int, View], depth_of: Callable[[int], Float]
) -> dict[int, DepthTies]:
    """Return the ties of each photograph; none where the backbone does not tell what it matched.

    depth_of: gives the depth map (H, W) of a photograph in its view's grid, 0 where unknown.
    """
    tracks = chosen_tracks(joined_tracks(state, store.stream_observations()), state.frames)
    if not len(tracks.points):
        return {}
    depth, sound = triangulated_depths(tracks, views)
    ties = {}
    for index in np.unique(tracks.image):
        view = views.get(int(index))
        if view is None:
            continue
        own = depth_of(int(index))
        rows = np.flatnonzero((tracks.image == index) & sound)
        rays = _rays(view, tracks.pixel[rows])
        pixels = rays[:, :2] * view.grid.fx + (view.grid.cx, view.grid.cy)
        size = np.array([view.grid.width, view.grid.height])
        cells = np.floor(pixels).astype(int)
        inside = ((cells >= 0) & (cells < size)).all(axis=-1)
        rows, cells, pixels = rows[inside], cells[inside], pixels[inside]
        seen = own[cells[:, 1], cells[:, 0]].astype(float)
        with np.errstate(divide="ignore"):
            log_ratio = np.log(depth[rows] / seen)
        near = np.abs(log_ratio) < TRACK_REACH
        if near.any():
            ties[int(index)] = DepthTies(2.0 * pixels[near] / size - 1.0, log_ratio[near])
    return ties


def triangulated_depths(tracks: Tracks, views: Mapping[int, View]) -> tuple[Float, Bool]:
    """Return the depths (M,) of the tracks' points in each image that sees them, and which are sound (M,).

    Points are those nearest to all rays of their track in the sense of least squares.
    """
    n, m = len(tracks.points), len(tracks.image)
    ray, centre, axis = (np.full((m, 3), np.nan) for _ in range(3))
    for index in np.unique(tracks.image):
        view, rows = views.get(int(index)), np.flatnonzero(tracks.image == index)
        if view is not None:
            ray[rows] = _rays(view, tracks.pixel[rows]) @ view.level_from_cam.rotation.T
            centre[rows], axis[rows] = view.level_from_cam.translation, view.level_from_cam.rotation[:, 2]
    unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    known = np.isfinite(unit).all(axis=1)
    square = np.where(known[:, None, None], np.eye(3) - unit[:, :, None] * unit[:, None, :], 0.0)
    middle = np.nanmean(centre, axis=0) if known.any() else np.zeros(3)
    offset = np.where(known[:, None], centre - middle, 0.0)
    pulled = np.einsum("mij,mj->mi", square, offset)
    normal = np.stack([np.bincount(tracks.point, square[:, i, j], n) for i in range(3) for j in range(3)], axis=-1)
    normal = normal.reshape(n, 3, 3)
    right = np.stack([np.bincount(tracks.point, pulled[:, i], n) for i in range(3)], axis=-1)
    rays_of = np.bincount(tracks.point, known, n)
    # The smallest eigenvalue is about the sum of the squared sines of the rays to their mean direction.
    wide = np.linalg.eigvalsh(normal)[:, 0] > np.maximum(rays_of, 1) * np.sin(np.radians(LEAST_ANGLE_DEG / 2)) ** 2
    points = np.full((n, 3), np.nan)
    points[wide] = np.linalg.solve(normal[wide], right[wide][..., None])[..., 0]
    from_centre = points[tracks.point] - offset
    depth = np.einsum("mi,mi->m", from_centre, axis)
    miss = np.linalg.norm(np.einsum("mij,mj->mi", square, from_centre), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        bad = ~((depth > 0.0) & (miss / depth < MOST_ERROR) & known)
    spoilt = np.bincount(tracks.point, bad, n) > 0
    return depth, ~bad & ~spoilt[tracks.point]


def _rays(view: View, photograph_pixels: Float) -> Float:
    camera = view.camera.resized(view.shot.width_px, view.shot.height_px)
    return camera.rays(photograph_pixels)
