"""Refinement: one bundle adjustment of all placed cameras over the features that the local models tied together.

A pose graph knows cameras only, one by one. Where the backbone tells which features of which images it
saw as one point, those tracks join across submaps and fix every camera and the shared intrinsics at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3, Sim3
from ..records import Observations, PlacedMap, Shot
from .bundle import Bundle, State
from .evidence import PrincipalPoint, calibrate
from .intrinsics import PARAMETERS, intrinsics_of
from .selfcal import IntrinsicsPrior

OBSERVATIONS = 40_000  # to aim at in all: a small map uses all that it has,
CELLS = 6  # an image at least
LEAST_PER_CELL = 3  # of its longest tracks in each of 6 x 6 cells
MIN_IMAGES = 3
MIN_OBSERVATIONS = 20  # an image with fewer follows the nearest refined one of its submap
ABSURD = 0.1  # of the image's longest side: an observation that starts farther off is a mismatch


@dataclass(frozen=True)
class Tracks:
    """Points of the map and the images that see them; one observation of a point in an image."""

    image: Int  # (M,) shot index
    pixel: Float  # (M, 2) photograph
    depth: Float  # (M,) along the camera's axis as its own submap predicted it, submap units; NaN elsewhere
    point: Int  # (M,) row of the point, ascending
    points: Float  # (N, 3) map frame


@dataclass(frozen=True)
class Refinement:
    """Refined cameras: for each image the similarity that takes its submap's frame to the map, and the intrinsics."""

    map_from_submap: Mapping[int, Sim3]  # by shot index
    calibrations: Mapping[str, Camera]  # by camera key, photograph size
    notes: Mapping[str, Any]  # JSON values for the report


def refine(
    state: PlacedMap,
    observed: Iterable[tuple[int, Observations]],
    shots: Mapping[int, Shot],
    principal_point: PrincipalPoint = "auto",
) -> Refinement | None:
    """Adjust all cameras that share enough tracks; None when there are none (neural backbones), or it does not settle.

    Args:
        state: the map; it is only read.
        observed: observations by number of the submap that made them.
        shots: at least those of the map.
        principal_point: whether that of the cameras is free, held in the middle, or as the evidence says.
    """
    tracks = chosen_tracks(joined_tracks(state, observed), state.frames)
    if len(_images(tracks)) < MIN_IMAGES:
        return None
    tracks = _only(tracks, _plausible(tracks, state, shots))
    images = _images(tracks)
    if len(images) < MIN_IMAGES:
        return None
    bundle = _bundle(tracks, images, state, shots)
    start = _start(tracks, images, state, bundle.free)
    try:
        solved = calibrate(bundle, start, principal_point)
    except (np.linalg.LinAlgError, RuntimeError):  # singular: numpy's word for it and SuperLU's
        return None
    adjusted = solved.state
    before, after = (np.linalg.norm(bundle.residuals(s), axis=1) for s in (start, adjusted))
    if not np.median(after) <= np.median(before):
        return None
    moved = _moved_frames(tracks, images, state, adjusted)
    return Refinement(
        map_from_submap=_with_followers(moved, state),
        calibrations={key: bundle.camera(key, adjusted) for key in bundle.free},
        notes={
            "refined_images": float(len(moved)),
            "refined_points": float(len(tracks.points)),
            "reprojection_before_px": float(np.median(before)),
            "reprojection_after_px": float(np.median(after)),
            "principal_point": dict(solved.verdict),
        },
    )


def joined_tracks(state: PlacedMap, observed: Iterable[tuple[int, Observations]]) -> Tracks:
    """Join observations of the same feature across submaps; tracks that see one image twice are mistaken and left out.

    A point starts at the mean of what the submaps predict for it.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    image, feature, pixel, depth, local_point, points = _collected(state, observed)
    if len(image) == 0:
        return Tracks(image, pixel, depth, local_point, points)
    key = image.astype(np.int64) << 32 | feature
    _, first, node = np.unique(key, return_index=True, return_inverse=True)
    n_nodes, n_local = len(first), len(points)
    graph = coo_matrix((np.ones(len(key), bool), (node, n_nodes + local_point)), shape=(n_nodes + n_local,) * 2)
    n_tracks, track = connected_components(graph, directed=False)

    total = np.stack([np.bincount(track[n_nodes:], points[:, k], n_tracks) for k in range(3)], axis=1)
    mean = total / np.maximum(np.bincount(track[n_nodes:], minlength=n_tracks), 1)[:, None]
    own_depth = np.full(n_nodes, np.nan)
    known = np.isfinite(depth)
    own_depth[node[known]] = depth[known]

    node_track, node_image = track[:n_nodes], image[first]
    distinct = np.unique(np.stack([node_track, node_image]), axis=1)
    images_of = np.bincount(distinct[0], minlength=n_tracks)
    sound = (np.bincount(node_track, minlength=n_tracks) == images_of) & (images_of >= 2)
    rows = np.flatnonzero(sound[node_track])
    rows = rows[np.argsort(node_track[rows], kind="stable")]
    kept, point = np.unique(node_track[rows], return_inverse=True)
    return Tracks(node_image[rows], pixel[first][rows], own_depth[rows], point, mean[kept])


def chosen_tracks(tracks: Tracks, frames: Mapping[int, object]) -> Tracks:
    """Return the tracks that are among the longest of a cell of some image, without images that have next to none."""
    count = np.bincount(tracks.point, minlength=len(tracks.points))
    width, height = (tracks.pixel.max(axis=0) + 1.0) if len(tracks.pixel) else (1.0, 1.0)
    cell = (tracks.pixel / (width, height) * CELLS).astype(int) @ (1, CELLS)
    group = tracks.image * CELLS**2 + cell
    order = np.lexsort((-count[tracks.point], group))
    in_order = group[order]
    rank = np.arange(len(order)) - np.searchsorted(in_order, in_order)
    best = np.zeros(len(tracks.points), bool)
    per_cell = max(LEAST_PER_CELL, OBSERVATIONS // (max(len(frames), 1) * CELLS**2))
    best[tracks.point[order[rank < per_cell]]] = True
    tracks = _only(tracks, best[tracks.point])
    enough = np.bincount(tracks.image, minlength=1) >= MIN_OBSERVATIONS
    return _only(tracks, enough[tracks.image])


def _plausible(tracks: Tracks, state: PlacedMap, shots: Mapping[int, Shot]) -> Bool:
    """Return which observations (M,) lie in front of their cameras and not absurdly far from where they should be."""
    images = _images(tracks)
    bundle = _bundle(tracks, images, state, shots)
    residual = np.linalg.norm(bundle.residuals(_start(tracks, images, state, bundle.free)), axis=1)
    longest = np.array([max(shots[i].width_px, shots[i].height_px) for i in images])
    # False where the residual is NaN, behind the camera.
    return np.asarray(residual <= ABSURD * longest[np.searchsorted(np.array(images), tracks.image)])


def _images(tracks: Tracks) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unique(tracks.image))


def _only(tracks: Tracks, keep: Bool) -> Tracks:
    """Return the observations to keep, without points that fewer than two images see."""
    count = np.bincount(tracks.point[keep], minlength=len(tracks.points))
    keep = keep & (count[tracks.point] >= 2)
    kept, point = np.unique(tracks.point[keep], return_inverse=True)
    return Tracks(tracks.image[keep], tracks.pixel[keep], tracks.depth[keep], point, tracks.points[kept])


def _collected(
    state: PlacedMap, observed: Iterable[tuple[int, Observations]]
) -> tuple[Int, Int, Float, Float, Int, Float]:
    parts: list[tuple[Int, Int, Float, Float, Int]] = []
    points: list[Float] = [np.zeros((0, 3))]
    offset = 0
    for submap, found in observed:
        placed = np.isin(found.image, list(state.frames))
        image = found.image[placed]
        depth = np.full(len(image), np.nan)
        for index in np.unique(image):
            frame = state.frames[int(index)]
            if frame.submap == submap:
                rows = np.flatnonzero(image == index)
                seen = found.points[found.point[placed][rows]].astype(float)
                depth[rows] = (seen - frame.submap_from_cam.translation) @ frame.submap_from_cam.rotation[:, 2]
        parts.append(
            (image, found.feature[placed], found.pixel[placed].astype(float), depth, found.point[placed] + offset)
        )
        points.append(state.map_from_submap[submap].apply(found.points.astype(float)))
        offset += len(found.points)
    empty = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), np.zeros(0, int)
    image, feature, pixel, depth, point = (np.concatenate(column) for column in zip(empty, *parts, strict=True))
    return image, feature, pixel, depth, point, np.concatenate(points)


def _bundle(tracks: Tracks, images: tuple[int, ...], state: PlacedMap, shots: Mapping[int, Shot]) -> Bundle:
    row = np.searchsorted(np.array(images), tracks.image)
    keys = tuple(shots[i].camera_key for i in images)
    free = tuple(sorted(set(keys) & set(state.calibrations)))
    priors = [prior_of(next(shots[i] for i in images if shots[i].camera_key == key)) for key in free]
    return Bundle(
        image=row,
        point=tracks.point,
        pixel=tracks.pixel,
        weight=np.ones(len(row)),
        keys=keys,
        free=free,
        cameras={**{shots[i].camera_key: _camera(i, state, shots) for i in images}},
        mean=np.array([prior.mean() for prior in priors]).reshape(-1, len(PARAMETERS)),
        whitening=np.array([prior.whitening() for prior in priors]).reshape(-1, len(PARAMETERS), len(PARAMETERS)),
        adjustable=np.ones(len(PARAMETERS), bool),
    )


def prior_of(shot: Shot) -> IntrinsicsPrior:
    """Return what a photograph's tags tell of its camera, photograph size."""
    focal = shot.focal_ratio * max(shot.width_px, shot.height_px)
    camera = Camera(shot.width_px, shot.height_px, focal, focal, shot.width_px / 2, shot.height_px / 2)
    return IntrinsicsPrior(camera, shot.focal_ratio_sigma)


def _camera(index: int, state: PlacedMap, shots: Mapping[int, Shot]) -> Camera:
    frame, shot = state.frames[index], shots[index]
    return frame.camera.through(frame.grid_from_photo.inverse(), shot.width_px, shot.height_px)


def _start(tracks: Tracks, images: tuple[int, ...], state: PlacedMap, free: tuple[str, ...]) -> State:
    poses = [state.map_from_cam(i) for i in images]
    return State(
        rotations=np.array([pose.rotation for pose in poses]),
        centres=np.array([pose.translation for pose in poses]),
        points=tracks.points,
        intrinsics=np.array([intrinsics_of(state.calibrations[key]) for key in free]).reshape(-1, len(PARAMETERS)),
    )


def _moved_frames(tracks: Tracks, images: tuple[int, ...], state: PlacedMap, adjusted: State) -> dict[int, Sim3]:
    """Return for each image the similarity under which its own prediction has the refined pose and depths."""
    row = np.searchsorted(np.array(images), tracks.image)
    offset = adjusted.points[tracks.point] - adjusted.centres[row]
    ratio = np.einsum("mi,mi->m", offset, adjusted.rotations[row][:, :, 2]) / tracks.depth
    moved = {}
    for k, index in enumerate(images):
        own = ratio[(row == k) & np.isfinite(ratio)]
        local = state.frames[index].submap_from_cam
        scale = float(np.median(own)) if len(own) else state.submap_pose_of(index).scale
        if scale > 0.0:
            moved[index] = _similarity(scale, Rigid3(adjusted.rotations[k], adjusted.centres[k]), local)
    return moved


def _similarity(scale: float, map_from_cam: Rigid3, submap_from_cam: Rigid3) -> Sim3:
    rotation = map_from_cam.rotation @ submap_from_cam.rotation.T
    return Sim3(scale, rotation, map_from_cam.translation - scale * rotation @ submap_from_cam.translation)


def _with_followers(moved: Mapping[int, Sim3], state: PlacedMap) -> dict[int, Sim3]:
    """Let the images that were not adjusted follow the nearest one that was, of their own submap where there is one."""
    if not moved:
        return {}
    refined = np.array(sorted(moved))
    centres = np.array([state.map_from_cam(int(i)).translation for i in refined])
    submaps = np.array([state.frames[int(i)].submap for i in refined])
    followed = dict(moved)
    for index, frame in state.frames.items():
        if index not in moved:
            distance = np.linalg.norm(centres - state.map_from_cam(index).translation, axis=1)
            nearest = int(refined[np.lexsort((distance, submaps != frame.submap))[0]])
            change = moved[nearest] @ state.submap_pose_of(nearest).inverse()
            followed[index] = change @ state.submap_pose_of(index)
    return followed
