"""Distances between two clouds: Acc., Comp., Chamfer, and the height of the ground, in bounded memory.

Acc. is the mean distance from points of the result to the nearest reference point, Comp. from the reference to the
result, CD their mean. Distances are exact; where a cloud is large they are taken from a random sample of its points.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..errors import ReferenceFormatError
from ..geometry.arrays import Float, Int
from ..geometry.transforms import Sim3
from .clouds import CloudFile

MAX_QUERIES = 200_000  # points of a cloud from which distances are taken: their mean is good to a few per mille
COARSE_POINTS = 50_000  # of the target: a first bound, so that far parts of it need no search


@dataclass(frozen=True)
class SurfaceErrors:
    """Distances in the unit of the reference; the numbers of points are those in the files."""

    accuracy: float  # mean, result -> reference
    completeness: float  # mean, reference -> result
    accuracy_median: float
    completeness_median: float
    n_result: int
    n_reference: int

    @property
    def chamfer(self) -> float:
        """Mean of accuracy and completeness."""
        return (self.accuracy + self.completeness) / 2.0


@dataclass(frozen=True)
class GroundDifference:
    """Height of the result above the reference over the cells of a horizontal grid that both fill."""

    median: float
    nmad: float  # spread, scaled to a standard deviation
    n_cells: int
    cell: float


def surface_errors(
    result: CloudFile, reference: CloudFile, reference_from_result: Sim3 | None = None, max_queries: int = MAX_QUERIES
) -> SurfaceErrors:
    """Return the distances between two clouds after moving the result by `reference_from_result`."""
    move = reference_from_result or Sim3()
    accuracy = nearest_distances(move.apply(sample(result, max_queries)), reference, Sim3())
    completeness = nearest_distances(sample(reference, max_queries), result, move)
    return SurfaceErrors(
        accuracy=float(accuracy.mean()),
        completeness=float(completeness.mean()),
        accuracy_median=float(np.median(accuracy)),
        completeness_median=float(np.median(completeness)),
        n_result=result.n_points,
        n_reference=reference.n_points,
    )


def sample(cloud: CloudFile, at_most: int, seed: int = 0) -> Float:
    """Return about `at_most` random points (N, 3) of a cloud, all of them where it has no more."""
    rng = np.random.default_rng(seed)
    share = at_most / cloud.n_points
    parts = [chunk if share >= 1.0 else chunk[rng.random(len(chunk)) < share] for chunk in cloud.chunks()]
    points: Float = np.concatenate(parts)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise ReferenceFormatError(f"{cloud.path}: none of its points is finite")
    return points


def nearest_distances(queries: Float, target: CloudFile, move: Sim3) -> Float:
    """Return the distance (N,) of each query (N, 3) to the nearest of all points of `target`, moved by `move`."""
    from scipy.spatial import cKDTree

    origin = queries.mean(axis=0)  # projected coordinates are large
    queries = queries - origin
    coarse = move.apply(sample(target, COARSE_POINTS)) - origin
    best = np.asarray(cKDTree(coarse).query(queries, workers=-1)[0])
    for chunk in target.chunks():
        points = move.apply(chunk[np.isfinite(chunk).all(axis=1)]) - origin
        if not len(points):
            continue
        outside = np.maximum(np.maximum(points.min(axis=0) - queries, queries - points.max(axis=0)), 0.0)
        near = np.flatnonzero(np.linalg.norm(outside, axis=1) < best)
        if len(near):
            found = cKDTree(points).query(queries[near], distance_upper_bound=best[near].max(), workers=-1)[0]
            best[near] = np.minimum(best[near], found)
    return best


def ground_difference(
    result: CloudFile, reference: CloudFile, cell: float, reference_from_result: Sim3 | None = None
) -> GroundDifference:
    """Compare mean heights cell by cell; the median over cells does not feel trees or noise that only one cloud has.

    Raises:
        ReferenceFormatError: the clouds share no cell.
    """
    move = reference_from_result or Sim3()
    keys, heights = _grid(map(move.apply, result.chunks()), cell)
    reference_keys, reference_heights = _grid(reference.chunks(), cell)
    _, here, there = np.intersect1d(keys, reference_keys, assume_unique=True, return_indices=True)
    if not len(here):
        raise ReferenceFormatError(f"{reference.path}: does not overlap {result.path} in plan; compare their CRS")
    difference = heights[here] - reference_heights[there]
    median = float(np.median(difference))
    return GroundDifference(median, 1.4826 * float(np.median(np.abs(difference - median))), len(here), cell)


def _grid(chunks: Iterable[Float], cell: float) -> tuple[Int, Float]:
    """Return the packed indices of the filled cells, ascending, and the mean height in each."""
    keys, total, count = np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    for chunk in chunks:
        points = chunk[np.isfinite(chunk).all(axis=1)]
        column, row = np.floor(points[:, :2] / cell).astype(np.int64).T
        chunk_keys = np.concatenate([keys, (row << 32) + (column & 0xFFFFFFFF)])
        keys, group = np.unique(chunk_keys, return_inverse=True)
        total = np.bincount(group, np.concatenate([total, points[:, 2]]), len(keys)).astype(float)
        count = np.bincount(group, np.concatenate([count, np.ones(len(points))]), len(keys)).astype(float)
    return keys, total / count
