"""Points sorted into square tiles on disk, so that a cloud larger than memory can be fused tile by tile.

Points are collected in memory, and each time the buffer is full written as one file ordered by tile; an index in
memory says where each tile lies in each file. The number of files therefore grows with the points, not with the tiles
that a few blunders scatter about.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

import numpy as np

from ..geometry.arrays import Float, Int
from ..records import CloudTile

# One point on disk; numpy's aligned layout of 40 bytes is copied ten times faster than a packed one.
POINT = np.dtype(
    [
        ("position", "<f8", 3),
        ("confidence", "<f4"),
        ("source", "<i4"),
        ("batch", "<i4"),
        ("rgb", "u1", 3),
        ("views", "u1"),
    ],
    align=True,
)
BUFFER_POINTS = 1_000_000
MAX_REACH_VOXELS = 2**27  # points further from the first batch are blunders and left out

Tile = tuple[int, int]  # column, row; tile (0, 0) begins at the origin of the export frame
_Run = tuple[Path, dict[int, tuple[int, int]]]  # file, packed tile -> (first, count)


def voxel_index(positions: Float, spacing_m: float) -> Int:
    """Return the voxel indices int64 of coordinates, any shape: the grid starts at the origin of the export frame."""
    return np.asarray(np.floor(positions / spacing_m).astype(np.int64))


class Spill:
    """A temporary store of points by tile; a tile holds its own points and those of a halo around it."""

    def __init__(self, work: Path, spacing_m: float, tile_voxels: int, halo_voxels: int) -> None:
        """`work` is created; the files in it are removed on leaving the context."""
        self._work, self._spacing_m = work, spacing_m
        self._tile_voxels, self._halo_voxels = tile_voxels, halo_voxels
        self._buffer: list[tuple[Int, np.ndarray]] = []  # (packed tile, points)
        self._buffered = 0
        self._runs: list[_Run] = []
        self._writer = ThreadPoolExecutor(1)
        self._writing: Future[_Run] | None = None
        self._centre: Float | None = None  # (3,) m, median of the first batch
        self._owned: set[int] = set()  # packed tiles with points of their own, not only of the halo

    def __enter__(self) -> Spill:
        self._work.mkdir(parents=True, exist_ok=True)
        for left in self._work.glob("spill-*.bin"):  # of a run that was killed
            left.unlink()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.shutdown()
        for written in self._work.glob("spill-*.bin"):
            written.unlink()

    def add(self, batch: CloudTile) -> None:
        """Add the points of a batch; those that are not finite, without confidence or absurdly far are left out."""
        points = self._usable(batch)
        if not len(points):
            return
        x, y = (voxel_index(points["position"][:, axis], self._spacing_m) for axis in (0, 1))
        column, row = x // self._tile_voxels, y // self._tile_voxels
        own = _pack(column, row)
        self._owned.update(np.unique(own).tolist())
        self._append(own, points)
        halo = self._halo_voxels
        local_x, local_y = x - column * self._tile_voxels, y - row * self._tile_voxels
        last = self._tile_voxels - halo
        near = np.flatnonzero((local_x < halo) | (local_x >= last) | (local_y < halo) | (local_y >= last))
        border, x, y, column, row = points[near], x[near], y[near], column[near], row[near]
        for dx, dy in ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)):
            # The neighbour in this direction, where the point is within the halo of it.
            to_column, to_row = (x + dx * halo) // self._tile_voxels, (y + dy * halo) // self._tile_voxels
            reaches = (to_column - column == dx) & (to_row - row == dy)
            if reaches.any():
                self._append(_pack(to_column[reaches], to_row[reaches]), border[reaches])
        if self._buffered >= BUFFER_POINTS:
            self.flush()

    def flush(self) -> None:
        """Have what is buffered written as one file ordered by tile, while more is collected."""
        self.settle()  # one file at a time: two would double what the buffer holds
        if not self._buffered:
            return
        path = self._work / f"spill-{len(self._runs):06d}.bin"
        self._writing = self._writer.submit(_write_run, path, self._buffer)
        self._buffer, self._buffered = [], 0

    def settle(self) -> None:
        """Wait for the file that is being written; raises what went wrong with it."""
        if self._writing is not None:
            writing, self._writing = self._writing, None
            self._runs.append(writing.result())

    def tiles(self) -> list[Tile]:
        """Return the tiles that own points, row by row."""
        return sorted((_unpack(key) for key in self._owned), key=lambda tile: (tile[1], tile[0]))

    def read(self, tile: Tile, low: tuple[int, int], high: tuple[int, int], limit: int | None) -> np.ndarray | None:
        """Return the tile's points (of dtype `POINT`) in voxels low <= (column, row) < high; None if above `limit`."""
        key = _pack_one(tile)
        parts, found = [], 0
        for path, index in self._runs:
            first, count = index.get(key, (0, 0))
            if not count:
                continue
            points = np.fromfile(path, POINT, count, offset=first * POINT.itemsize)
            x, y = (voxel_index(points["position"][:, axis], self._spacing_m) for axis in (0, 1))
            inside = (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
            parts.append(points if inside.all() else points[inside])
            found += len(parts[-1])
            if limit is not None and found > limit:
                return None
        return np.concatenate(parts) if parts else np.zeros(0, POINT)

    def _usable(self, batch: CloudTile) -> np.ndarray:
        keep = batch.confidence > 0.0
        for axis in range(3):
            keep &= np.isfinite(batch.points[:, axis])
        if self._centre is None and keep.any():
            self._centre = np.asarray(np.median(batch.points[keep], axis=0))
        if self._centre is not None:
            reach_m = MAX_REACH_VOXELS * self._spacing_m
            for axis in range(3):
                with np.errstate(invalid="ignore"):  # inf - inf, already left out
                    keep &= np.abs(batch.points[:, axis] - self._centre[axis]) < reach_m
        points = np.zeros(int(np.count_nonzero(keep)), POINT)
        chosen = slice(None) if len(points) == len(keep) else keep  # mostly all, which spares a copy
        points["position"], points["rgb"] = batch.points[chosen], batch.rgb[chosen]
        points["confidence"], points["source"] = batch.confidence[chosen], batch.source[chosen]
        points["batch"], points["views"] = batch.batch[chosen], np.clip(batch.views[chosen], 1, 255)
        return points

    def _append(self, tile: Int, points: np.ndarray) -> None:
        self._buffer.append((tile, points))
        self._buffered += len(points)


def _write_run(path: Path, parts: list[tuple[Int, np.ndarray]]) -> _Run:
    keys = np.concatenate([key for key, _ in parts])
    points = np.concatenate([part for _, part in parts])
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=keys[0] - 1))
    count = np.diff(first, append=len(keys))
    np.take(points, order).tofile(path)
    return path, {int(t): (int(f), int(c)) for t, f, c in zip(keys[first], first, count, strict=True)}


def _pack(column: Int, row: Int) -> Int:
    return np.asarray((row << 32) + (column & 0xFFFFFFFF))


def _pack_one(tile: Tile) -> int:
    return (tile[1] << 32) + (tile[0] & 0xFFFFFFFF)


def _unpack(key: int) -> Tile:
    column = key & 0xFFFFFFFF
    return column - (1 << 32 if column >= 1 << 31 else 0), key >> 32
