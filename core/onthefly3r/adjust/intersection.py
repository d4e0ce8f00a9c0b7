"""All tracks of a finished map, intersected anew with its final cameras."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.arrays import Float, Int
from ..records import Observations, PlacedMap, Shot
from .evidence import intersect
from .refine import bundle_of, start_of
from .tracks import MIN_OBSERVATIONS, Tracks, images_of, joined_tracks, only

WORST_PX = 4.0  # observations that are farther off are mismatches
WORST_NOISE = 4.0  # times the noise, where that is more


@dataclass(frozen=True)
class Intersected:
    """Points of the map and the observations that agree with them."""

    points: Float  # (N, 3) map frame
    error_px: Float  # (N,) mean reprojection error
    image: Int  # (M,) shot index
    point: Int  # (M,) row of points
    pixel: Float  # (M, 2) upright photograph


def intersected_tracks(
    state: PlacedMap, observed: Iterable[tuple[int, Observations]], shots: Mapping[int, Shot]
) -> Intersected | None:
    """Return the tracks of two or more images with their points; None where the local models brought none."""
    tracks = joined_tracks(state, observed)
    count = np.bincount(tracks.image, minlength=1)
    tracks = only(tracks, count[tracks.image] >= MIN_OBSERVATIONS)
    images = images_of(tracks)
    if not images:
        return None
    tracks = replace(tracks, points=_by_depths(tracks, state, shots))
    for _ in range(2):
        bundle = bundle_of(tracks, images, state, shots)
        found = intersect(bundle, start_of(tracks, images, state, bundle.free))
        error = np.linalg.norm(bundle.residuals(found), axis=1)
        worst = max(WORST_PX, WORST_NOISE * bundle.noise_px(found))
        good = np.isfinite(error) & (error <= worst)
        if not good.any():
            return None
        tracks = only(replace(tracks, points=found.points), good)
        images = images_of(tracks)
        if not images:
            return None
        if good.all():
            break
    else:
        bundle = bundle_of(tracks, images, state, shots)
        found = start_of(tracks, images, state, bundle.free)
        error = np.linalg.norm(bundle.residuals(found), axis=1)
    n = len(tracks.points)
    return Intersected(
        points=tracks.points,
        error_px=np.bincount(tracks.point, error, n) / np.maximum(np.bincount(tracks.point, minlength=n), 1),
        image=tracks.image,
        point=tracks.point,
        pixel=tracks.pixel,
    )


def _by_depths(tracks: Tracks, state: PlacedMap, shots: Mapping[int, Shot]) -> Float:
    """Return where points (N, 3) start: the mean of what their images predicted, each where it lies now."""
    total, seen = np.zeros_like(tracks.points), np.zeros(len(tracks.points))
    for index in images_of(tracks):
        rows = np.flatnonzero((tracks.image == index) & np.isfinite(tracks.depth))
        frame, shot = state.frames[index], shots[index]
        camera = state.calibrations.get(shot.camera_key) or frame.camera.through(
            frame.grid_from_photo.inverse(), shot.width_px, shot.height_px
        )
        local = camera.rays(tracks.pixel[rows]) * tracks.depth[rows, None]
        place = state.submap_pose_of(index).apply(frame.submap_from_cam.apply(local))
        np.add.at(total, tracks.point[rows], place)
        np.add.at(seen, tracks.point[rows], 1.0)
    return np.where(seen[:, None] > 0.0, total / np.maximum(seen, 1.0)[:, None], tracks.points)
