"""The point cloud as a Cloud Optimized Point Cloud (COPC 1.0): LAZ whose chunks are the nodes of an octree.

Specification: https://copc.io. Written by ourselves on lazrs, since no package that writes COPC has wheels for every
system and Python that we support.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..errors import ReconstructionError
from ..files.atomic import replacing
from ..geometry.arrays import Float, Int
from ..records import CloudTile
from .las import LOCAL_WKT1, MAX_POINT_SOURCE, CloudSummary, SpacingMeter, las_header, las_record
from .spool import Extent

CELLS = 128  # of a node along each axis; a node holds at most one point in each, but for the deepest level
MAX_LEVEL = 20
RUN_POINTS = 1_000_000  # sorted in memory at once
INFO = struct.Struct("<5d2Q2d11Q")  # centre, half size, spacing, hierarchy offset and size, GPS times, reserved
ENTRY = struct.Struct("<4iQ2i")  # level, x, y, z, offset, bytes, points
INFO_OFFSET = 375 + 54  # of the LAS header and of the header of the first VLR
HASH = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True)
class Octree:
    """The cube of the root and its levels."""

    corner: Float  # (3,) lowest corner, m
    side_m: float
    depth: int  # the deepest level

    @classmethod
    def of(cls, extent: Extent, spacing_m: float) -> Octree:
        """Return the octree whose deepest level has cells no larger than the spacing of the cloud."""
        side_m = max(float((extent.high - extent.low).max()) * 1.001, spacing_m)
        depth = int(np.clip(np.ceil(np.log2(side_m / (CELLS * spacing_m))), 0, MAX_LEVEL))
        return cls(extent.low - 0.0005 * side_m, side_m, depth)

    @property
    def centre(self) -> Float:
        """The middle of the cube (3,)."""
        return np.asarray(self.corner + self.side_m / 2.0)

    def nodes(self, points: Float, seen: list[set[int]]) -> Int:
        """Return the node (N, 4) level, x, y, z of each point.

        Coarse levels take one point of each of their cells that is still empty; the deepest takes the rest. `seen`
        holds the cells that are taken, by level, and is added to.
        """
        level = np.full(len(points), self.depth, np.int64)
        place = (points - self.corner) / self.side_m
        left = _mixed(points)  # an order that has nothing to do with the place, for an even choice
        for depth in range(self.depth):
            cells = np.clip((place[left] * (CELLS << depth)).astype(np.int64), 0, (CELLS << depth) - 1)
            key = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
            cell, first = np.unique(key, return_index=True)
            if depth < len(seen):
                fresh = np.fromiter((int(c) not in seen[depth] for c in cell), bool, len(cell))
                seen[depth].update(cell[fresh].tolist())
                first = first[fresh]
            level[left[first]] = depth
            left = np.delete(left, first)
        across = np.left_shift(1, level)
        node = np.clip((place * across[:, None]).astype(np.int64), 0, across[:, None] - 1)
        return np.column_stack([level, node])


def _mixed(points: Float) -> Int:
    bits = np.ascontiguousarray(points[:, 0] * 31.0 + points[:, 1] * 17.0 + points[:, 2]).view(np.uint64)
    return np.argsort(bits * HASH, kind="stable")


class CopcWriter:
    """A COPC file that is written tile by tile; a context manager, whose `summary` is there at its end.

    Fields are those of `las.CloudWriter`. Points are sorted by node in runs on disk: memory holds one run.
    """

    SHARED_LEVELS = 3  # whose cells may lie in several tiles

    def __init__(
        self,
        path: Path,
        work: Path,
        extent: Extent,
        spacing_m: float,
        wkt1: str | None,
        scale_m: float,
        description: str = "",
        n_images: int = 0,
        part_of: Int | None = None,
    ) -> None:
        """`extent` must hold all points; the other arguments are those of `las.write_cloud`."""
        self._path, self._work, self._octree = path, work / "copc", Octree.of(extent, spacing_m)
        self._wide, self._part_of = n_images > MAX_POINT_SOURCE, part_of
        offset = np.round((extent.low + extent.high) / 2.0)
        in_parts = part_of is not None
        self._header = las_header(offset, scale_m, wkt1 or LOCAL_WKT1, description, self._wide, in_parts)
        self._seen: list[set[int]] = [set() for _ in range(min(self.SHARED_LEVELS, self._octree.depth))]
        self._buffer: list[tuple[Int, Any]] = []
        self._buffered = 0
        self._runs: list[tuple[Path, dict[tuple[int, ...], tuple[int, int]]]] = []
        self._meter = SpacingMeter()
        self.summary: CloudSummary | None = None

    def __enter__(self) -> CopcWriter:
        self._work.mkdir(parents=True, exist_ok=True)
        return self

    def add(self, tile: CloudTile) -> None:
        """Take the points of a tile in the export frame."""
        if not len(tile.points):
            return
        record = las_record(tile, self._header, self._wide, self._part_of)
        self._buffer.append((self._octree.nodes(tile.points, self._seen), record))
        self._buffered += len(tile.points)
        self._meter.add(tile.points)
        if self._buffered >= RUN_POINTS:
            self._flush()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            for path in self._work.glob("run-*.bin"):
                path.unlink()
            self._work.rmdir()

    def _flush(self) -> None:
        if not self._buffered:
            return
        nodes = np.concatenate([node for node, _ in self._buffer])
        records = np.concatenate([record.array for _, record in self._buffer])
        order = np.lexsort(nodes.T[::-1])
        nodes, records = nodes[order], records[order]
        first = np.flatnonzero(np.any(np.diff(nodes, axis=0, prepend=-1), axis=1))
        count = np.diff(first, append=len(nodes))
        path = self._work / f"run-{len(self._runs):06d}.bin"
        records.tofile(path)
        index = {tuple(int(n) for n in nodes[f]): (int(f), int(c)) for f, c in zip(first, count, strict=True)}
        self._runs.append((path, index))
        self._buffer, self._buffered = [], 0

    def _finish(self) -> None:
        self._flush()
        if not self._runs:
            raise ReconstructionError("the cloud has no points; lower min_confidence")
        with replacing(self._path) as temporary, temporary.open("w+b") as stream:
            self._write(stream)

    def _write(self, stream: Any) -> None:
        import laspy
        import lazrs

        header, total = self._header, Counter[tuple[int, ...]]()
        for _, index in self._runs:
            total.update({node: count for node, (_, count) in index.items()})
        itemsize = header.point_format.size
        laz = lazrs.LazVlr.new_for_compression(header.point_format.id, header.point_format.num_extra_bytes, True)
        own = list(header.vlrs)
        header.vlrs.clear()
        header.vlrs.append(laspy.VLR("copc", 1, "COPC info VLR", bytes(INFO.size)))
        header.vlrs.append(laspy.VLR("laszip encoded", 22204, "laszip encoded", laz.record_data()))
        header.vlrs.extend(own)
        header.are_points_compressed = True
        header.write_to(stream)
        start = stream.tell()
        compressor = lazrs.LasZipCompressor(stream, laz)
        low, high = np.full(3, 2**31), np.full(3, -(2**31))
        nodes = sorted(total)
        for node in nodes:
            points = np.concatenate([self._read(path, index[node]) for path, index in self._runs if node in index])
            for axis, name in enumerate("XYZ"):
                low[axis] = min(low[axis], int(points[name].min()))
                high[axis] = max(high[axis], int(points[name].max()))
            compressor.compress_many(np.frombuffer(points.tobytes(), np.uint8))
            compressor.finish_current_chunk()
        compressor.done()
        assert itemsize == points.dtype.itemsize
        self._close(stream, start, laz, nodes, total, low, high)

    def _close(
        self,
        stream: Any,
        start: int,
        laz: Any,
        nodes: list[tuple[int, ...]],
        total: Counter[tuple[int, ...]],
        low: Int,
        high: Int,
    ) -> None:
        """Write the hierarchy behind the points, and the figures that are known now into the header."""
        import lazrs

        stream.seek(start)
        table = lazrs.read_chunk_table(stream, laz)
        sizes = dict(zip(nodes, (size for _, size in table), strict=False))
        offsets, at = {}, start + 8
        for node in nodes:
            offsets[node] = at
            at += sizes[node]
        entries = _with_parents(nodes)
        page = b"".join(
            ENTRY.pack(*node, offsets[node], sizes[node], total[node]) if node in total else ENTRY.pack(*node, 0, 0, 0)
            for node in entries
        )
        stream.seek(0, 2)
        evlr = stream.tell()
        stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(page), b"EPT hierarchy"))
        stream.write(page)
        header, octree = self._header, self._octree
        header.point_count = sum(total.values())
        header.number_of_points_by_return[0] = header.point_count
        header.mins, header.maxs = (ends * header.scales + header.offsets for ends in (low, high))
        header.start_of_first_evlr, header.number_of_evlrs = evlr, 1
        stream.seek(0)
        header.write_to(stream, ensure_same_size=True)
        stream.seek(INFO_OFFSET)
        half = octree.side_m / 2.0
        hierarchy = evlr + 60
        stream.write(
            INFO.pack(*octree.centre, half, octree.side_m / CELLS, hierarchy, len(page), 0.0, 0.0, *([0] * 11))
        )
        bounds = tuple(float(value) for value in (*header.mins, *header.maxs))
        self.summary = CloudSummary(
            path=self._path,
            points=header.point_count,
            bounds=bounds,  # type: ignore[arg-type]
            window=self._meter.window,
            mean_spacing_m=self._meter.spacing_m,
        )

    def _read(self, path: Path, place: tuple[int, int]) -> Any:
        dtype = self._header.point_format.dtype()
        return np.fromfile(path, dtype, place[1], offset=place[0] * dtype.itemsize)


def _with_parents(nodes: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Return the nodes and all above them up to the root, which the hierarchy must name even when they are empty."""
    found = set(nodes)
    for level, x, y, z in nodes:
        while level > 0:
            level, x, y, z = level - 1, x // 2, y // 2, z // 2
            if (level, x, y, z) in found:
                break
            found.add((level, x, y, z))
    return sorted(found)
