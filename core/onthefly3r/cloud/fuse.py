"""Fusion of overlapping point batches into one voxel-thinned cloud, in bounded memory.

Incoming points are spilled to disk, sorted into square tiles of a global voxel grid; each tile is then fused on its
own. A tile also receives the voxels of a halo around it, so that what is decided at a border (the stray filter) is
decided on the same points from both sides, and each voxel is written by the one tile it belongs to.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from ..geometry.arrays import Bool, Int
from ..geometry.spacing import point_spacing
from ..records import CloudTile
from .spill import Spill, Tile, voxel_index

TILE_VOXELS = 256  # side of a tile
MAX_TILES_AT_ONCE = 4  # each thread works on one
MAX_SQUARE_POINTS = 1_000_000  # a square with more input points is fused in quarters,
MIN_SQUARE_VOXELS = 8  # down to this side
# A voxel is stray with fewer occupied voxels than this among the 124 around it (5 x 5 x 5): a smooth surface has
# about 24 of them, its corner 8. Where the points lie further apart than the voxels, the reach grows with them.
MIN_NEIGHBOURS = 4
STRAY_REACH = 2.0  # voxels, or point spacings where those are larger
MAX_STRAY_REACH = 16  # voxels

FuseProgress = Callable[[int, int], None]  # (tiles done, tiles in all); may raise `Cancelled`


def fuse(
    tiles_in: Iterable[CloudTile],
    spacing_m: float,
    min_confidence: float,
    work: Path,
    stray_filter: bool,
    progress: FuseProgress | None = None,
    threads: int = 1,
) -> Iterator[CloudTile]:
    """Yield the fused cloud of overlapping batches tile by tile, one point per occupied voxel.

    Position and colour are means weighted by confidence; source and batch are those of the most confident
    observation; views counts distinct images, or what a point brings along if that is more. The confidence of a voxel
    with n images, whose points are each the work of m images, and mean observed confidence c is
    1 - (1 - c)^sqrt(n / m): one image keeps its own, agreeing images add up, but less than independent ones would,
    because images of one local model share its errors. Images that a point already counts (n <= m) add nothing. Points
    that are not finite or have no confidence are left out.

    Args:
        tiles_in: unfused points in one frame in metres; one record per image or batch, any order.
        spacing_m: side of the cubic voxels, m; the grid starts at the origin of the export frame.
        min_confidence: fused points below it are dropped, 0..1.
        work: folder for temporary files (40 bytes a point), removed from it at the end.
        stray_filter: drop voxels with fewer than `MIN_NEIGHBOURS` occupied ones around them.
        progress: called after each tile; an exception it raises stops the fusion.
        threads: of the processor; at most `MAX_TILES_AT_ONCE` are used.

    Raises:
        ValueError: spacing_m is not positive.
    """
    if not spacing_m > 0.0:
        raise ValueError(f"spacing_m must be positive, not {spacing_m}")
    batches = iter(tiles_in)
    first = next(batches, None)
    if first is None:
        return
    reach = _stray_reach(first, spacing_m) if stray_filter else 0
    at_once = min(threads, MAX_TILES_AT_ONCE)
    with Spill(work, spacing_m, TILE_VOXELS, reach) as spill, ThreadPoolExecutor(at_once) as pool:
        for batch in chain([first], batches):
            spill.add(batch)
        spill.flush()
        spill.settle()
        tiles = spill.tiles()

        def fused(tile: Tile) -> list[CloudTile]:
            corner = (tile[0] * TILE_VOXELS, tile[1] * TILE_VOXELS)
            squares = _squares(spill, tile, corner, TILE_VOXELS, reach)
            return [_fuse_square(square, spacing_m, min_confidence, reach) for square in squares]

        for done, parts in enumerate(_mapped(pool, fused, tiles, at_once), start=1):
            yield from (part for part in parts if len(part.points))
            if progress is not None:
                progress(done, len(tiles))


def _mapped(
    pool: Executor, function: Callable[[Tile], list[CloudTile]], tiles: Sequence[Tile], at_once: int
) -> Iterator[list[CloudTile]]:
    """Yield the results in order; only so many are made ahead, for the sake of memory."""
    ahead = deque(pool.submit(function, tile) for tile in tiles[:at_once])
    for following in [*tiles[at_once:], *[None] * len(ahead)]:
        result = ahead.popleft().result()
        if following is not None:
            ahead.append(pool.submit(function, following))
        yield result


@dataclass(frozen=True)
class _Square:
    points: np.ndarray  # dtype spill.POINT, the square and its halo
    corner: tuple[int, int]  # first column and row of the square, voxels
    side: int  # voxels


def _stray_reach(batch: CloudTile, spacing_m: float) -> int:
    """Return how many voxels around a voxel the stray filter looks at, from the density of the first batch."""
    finite = batch.points[np.isfinite(batch.points).all(axis=1)]
    typical = point_spacing(finite) / spacing_m
    return int(min(np.ceil(STRAY_REACH * (typical if typical > 1.0 else 1.0)), MAX_STRAY_REACH))


def _squares(spill: Spill, tile: Tile, corner: tuple[int, int], side: int, halo: int) -> Iterator[_Square]:
    """Yield the tile as one square, or in quarters where it holds too many points for memory."""
    low = (corner[0] - halo, corner[1] - halo)
    high = (corner[0] + side + halo, corner[1] + side + halo)
    points = spill.read(tile, low, high, MAX_SQUARE_POINTS if side > MIN_SQUARE_VOXELS else None)
    if points is not None:
        if len(points):
            yield _Square(points, corner, side)
        return
    half = side // 2
    for row in (corner[1], corner[1] + half):
        for column in (corner[0], corner[0] + half):
            yield from _squares(spill, tile, (column, row), half, halo)


def _fuse_square(square: _Square, spacing_m: float, min_confidence: float, reach: int) -> CloudTile:
    points = square.points
    xyz = np.ascontiguousarray(points["position"].T)  # (3, N): long rows are what numpy is fast on
    voxel = voxel_index(xyz, spacing_m)
    order, starts, views = _group(voxel, points["source"].astype(np.int64))
    sizes = np.diff(starts, append=len(points))
    group = np.empty(len(points), np.int64)  # voxel number of each point
    group[order] = np.repeat(np.arange(len(starts)), sizes)

    observed = points["confidence"].astype(float)
    weight = np.bincount(group, observed)
    origin = xyz[:, :1].copy()  # keeps the sums small: projected coordinates are large
    xyz -= origin
    position = np.stack([np.bincount(group, observed * row) for row in xyz], axis=1) / weight[:, None]
    rgb = np.stack([np.bincount(group, observed * points["rgb"][:, k]) for k in range(3)], axis=1) / weight[:, None]
    mean_confidence = np.clip(weight / sizes, 0.0, 1.0)
    behind = np.maximum.reduceat(points["views"][order], starts)  # images behind a point
    more = np.maximum(views / behind, 1.0)
    confidence = (1.0 - (1.0 - mean_confidence) ** np.sqrt(more)).astype(np.float32)
    views = np.maximum(views, behind)

    in_order = observed[order]
    candidates = order[in_order == np.repeat(np.maximum.reduceat(in_order, starts), sizes)]
    strongest = np.empty(len(starts), np.int64)
    strongest[group[candidates[::-1]]] = candidates[::-1]  # of equals the image with the lowest number stays

    cell = voxel[:, order[starts]]
    keep = confidence >= np.float32(min_confidence)
    if reach:
        keep[keep] = _has_neighbours(cell[:, keep], reach)
    for axis, first in enumerate(square.corner):  # without the halo
        keep &= (cell[axis] >= first) & (cell[axis] < first + square.side)
    best = points[strongest[keep]]
    return CloudTile(
        points=position[keep] + origin.T,
        rgb=np.rint(rgb[keep]).astype(np.uint8),
        confidence=confidence[keep],
        source=best["source"],
        batch=best["batch"],
        views=views[keep].astype(np.int32),
    )


def _group(voxel: Int, source: Int) -> tuple[Int, Int, Int]:
    """Return (order by voxel and image, start of each voxel in that order, distinct images of each voxel)."""
    images = int(source.max() - source.min()) + 1
    key = _key(voxel, pad=0)[0] * images + (source - source.min())
    order = np.argsort(key)
    key = key[order]
    first_of_image = np.diff(key, prepend=-1) != 0
    starts = np.flatnonzero(np.diff(key // images, prepend=-1))
    return order, starts, np.add.reduceat(first_of_image.astype(np.int64), starts)


def _has_neighbours(cell: Int, reach: int) -> Bool:
    """Return which of the distinct cells (3, N), ordered by `_key`, have enough others within `reach` on every axis."""
    if not cell.size:
        return np.zeros(0, bool)
    key, column_step, row_step = _key(cell, pad=reach)
    count = np.full(cell.shape[1], -1)  # a cell is no neighbour of its own
    undecided = np.arange(cell.shape[1])
    columns = [(dx, dy) for dx in range(-reach, reach + 1) for dy in range(-reach, reach + 1)]
    for dx, dy in sorted(columns, key=lambda step: step[0] ** 2 + step[1] ** 2):  # near ones settle most cells
        middle = key[undecided] + dx * column_step + dy * row_step
        count[undecided] += np.searchsorted(key, middle + reach, "right") - np.searchsorted(key, middle - reach, "left")
        undecided = undecided[count[undecided] < MIN_NEIGHBOURS]
    return np.asarray(count >= MIN_NEIGHBOURS)


def _key(voxel: Int, pad: int) -> tuple[Int, int, int]:
    """Return one number per voxel of (3, N), ordered by (x, y, z), and its steps along x and y.

    With `pad` empty voxels on every side a step of at most `pad` never wraps round into another column.
    """
    low = voxel.min(axis=1) - pad
    _, ny, nz = (int(n) for n in voxel.max(axis=1) + pad - low + 1)
    x, y, z = voxel - low[:, None]
    return (x * ny + y) * nz + z, ny * nz, nz
