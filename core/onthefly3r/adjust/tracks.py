"""Tracks: which features of which images are one point of the map, joined across submaps and chosen for cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..records import Observations, PlacedMap

OBSERVATIONS = 40_000  # to aim at in all: a small map uses all that it has,
CELLS = 6  # an image at least
LEAST_PER_CELL = 3  # of its longest tracks in each of 6 x 6 cells
MIN_OBSERVATIONS = 20  # an image with fewer follows the nearest refined one of its submap


@dataclass(frozen=True)
class Tracks:
    """Points of the map and the images that see them; one observation of a point in an image."""

    image: Int  # (M,) shot index
    pixel: Float  # (M, 2) photograph
    depth: Float  # (M,) along the camera's axis as its own submap predicted it, submap units; NaN elsewhere
    point: Int  # (M,) row of the point, ascending
    points: Float  # (N, 3) map frame


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
    tracks = only(tracks, best[tracks.point])
    enough = np.bincount(tracks.image, minlength=1) >= MIN_OBSERVATIONS
    return only(tracks, enough[tracks.image])


def images_of(tracks: Tracks) -> tuple[int, ...]:
    """Return the shot indices of the images that see a point, ascending."""
    return tuple(int(i) for i in np.unique(tracks.image))


def only(tracks: Tracks, keep: Bool) -> Tracks:
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
        if submap not in state.map_from_submap:  # of a part of the map that is not looked at
            continue
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
