"""Compact geometric references (Eq. 2) and the correspondences that they give (Eq. 10)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.transforms import Sim3
from ..records import CompactReference, Correspondences, LocalModel, LocalView

CELLS_ACROSS = 16
# More points of one image repeat its errors and cost time.
MAX_PAIRS_PER_REFERENCE = 500


def compact_reference(view: LocalView, max_points: int, min_confidence: float) -> CompactReference:
    """Return H_i (Eq. 2): the most confident points of each cell of a regular image grid, the same number per cell.

    Points that later models of the image will hold too come first: the others would find nothing to correspond to.
    """
    height, width = view.confidence.shape
    cell_px = max(1, -(-width // CELLS_ACROSS))
    cells_down = -(-height // cell_px)
    per_cell = max(1, max_points // (CELLS_ACROSS * cells_down))
    ranked = np.full((cells_down * cell_px, CELLS_ACROSS * cell_px), -np.inf, np.float32)
    rank = view.confidence if view.recurring is None else view.confidence + view.recurring
    ranked[:height, :width] = np.where(trusted_pixels(view, min_confidence), rank, -np.inf)
    cells = ranked.reshape(cells_down, cell_px, CELLS_ACROSS, cell_px).swapaxes(1, 2).reshape(-1, cell_px**2)
    best = np.argpartition(-cells, min(per_cell, cell_px**2) - 1, axis=1)[:, :per_cell]
    cell, place = np.nonzero(np.isfinite(np.take_along_axis(cells, best, axis=1)))
    pixel = best[cell, place]
    rows, columns = cell // CELLS_ACROSS * cell_px + pixel // cell_px, cell % CELLS_ACROSS * cell_px + pixel % cell_px
    return CompactReference(
        pixels=np.column_stack([columns, rows]).astype(np.int32),
        points=view.points[rows, columns].astype(np.float32),
        confidence=view.confidence[rows, columns].astype(np.float32),
    )


def trusted_pixels(view: LocalView, min_confidence: float) -> Bool:
    """Return the pixels (H, W) of a point map that hold a point of at least this confidence."""
    x, y, z = np.moveaxis(view.points, -1, 0)
    return np.asarray((view.confidence >= min_confidence) & np.isfinite(x) & np.isfinite(y) & np.isfinite(z))


def correspond(
    model: LocalModel,
    references: Mapping[int, CompactReference],
    map_from_submap: Mapping[int, Sim3],
    min_confidence: float,
) -> Correspondences:
    """Pair stored map points with the local points at the same pixels (Eq. 10).

    Args:
        model: the new local model.
        references: H_r by shot index, of references that the model may contain.
        map_from_submap: for each of them, the pose of the submap that predicted its points.
        min_confidence: local points below it are not used.
    """
    local, mapped, weight, source = [], [], [], []
    for index, reference in references.items():
        view = model.views.get(index)
        if view is None or len(reference.pixels) == 0:
            continue
        columns, rows = reference.pixels[:, 0], reference.pixels[:, 1]
        points, confidence = view.points[rows, columns].astype(float), view.confidence[rows, columns].astype(float)
        valid = spread_sample(
            np.flatnonzero((confidence >= min_confidence) & np.isfinite(points).all(axis=-1)), MAX_PAIRS_PER_REFERENCE
        )
        local.append(points[valid])
        mapped.append(map_from_submap[index].apply(reference.points[valid].astype(float)))
        weight.append(np.sqrt(confidence[valid] * reference.confidence[valid]))  # w = sqrt(c_local c_global), Eq. 10
        source.append(np.full(len(valid), index))
    if not local:
        return Correspondences(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, int))
    return Correspondences(np.vstack(local), np.vstack(mapped), np.concatenate(weight), np.concatenate(source))


def spread_sample(items: Int, count: int) -> Int:
    """Return at most `count` of the items at even steps: of points ordered by cell, some of every part of the image."""
    if len(items) <= count:
        return items
    return np.asarray(items[np.linspace(0, len(items) - 1, count).astype(int)])


def scene_spacing(views: Mapping[int, LocalView], min_confidence: float) -> float:
    """Return l_scene: the median 3D distance of neighbouring confident pixels (paper Sec. III-B), NaN if none."""
    steps: list[Float] = []
    for view in views.values():
        trusted = np.where((view.confidence >= min_confidence)[..., None], view.points, np.nan)
        distance = np.linalg.norm(np.diff(trusted, axis=1), axis=-1)
        steps.append(distance[np.isfinite(distance)])
    joined = np.concatenate(steps) if steps else np.zeros(0)
    return float(np.median(joined)) if len(joined) else float("nan")
