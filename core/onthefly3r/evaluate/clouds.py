"""Points of LAS, LAZ and PLY files, read in chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ReferenceFormatError
from ..geometry.arrays import Float
from .las_file import open_las

CHUNK_POINTS = 1_000_000
MAX_HEADER_LINES = 1_000
PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass(frozen=True)
class CloudFile:
    """A point cloud on disk that can be read several times."""

    path: Path
    n_points: int
    chunks: Callable[[], Iterator[Float]]  # each (N, 3) float64
    crs: Any = None  # pyproj.CRS that the file states
    bounds: Float | None = None  # (2, 3) lowest and highest coordinates that the header states
    single_precision: bool = False  # coordinates are stored as float32


def open_cloud(path: Path) -> CloudFile:
    """Look at the header of a cloud; `path` may be an output folder of ours, which holds one cloud of ours.

    Raises:
        ReferenceFormatError: missing, empty, not LAS, LAZ or PLY, or damaged.
    """
    if path.is_dir():
        found = [path / name for name in ("cloud.laz", "cloud.las", "cloud.copc.laz") if (path / name).is_file()]
        if not found:
            raise ReferenceFormatError(f"{path}: holds no cloud.laz, cloud.las or cloud.copc.laz")
        path = found[0]
    if not path.is_file():
        raise ReferenceFormatError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        las = open_las(path)
        cloud = CloudFile(path, las.n_points, las.chunks, las.crs, las.bounds)
    elif suffix == ".ply":
        cloud = _open_ply(path)
    else:
        raise ReferenceFormatError(f"{path}: clouds are read from .las, .laz and .ply files")
    if cloud.n_points == 0:
        raise ReferenceFormatError(f"{path}: has no points")
    return cloud


def bounds_of(cloud: CloudFile) -> Float:
    """Return the lowest and highest coordinates (2, 3), from the header or from all points."""
    if cloud.bounds is not None:
        return cloud.bounds
    boxes = [np.stack([chunk.min(axis=0), chunk.max(axis=0)]) for chunk in cloud.chunks() if len(chunk)]
    return np.stack([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


@dataclass(frozen=True)
class _PlyHeader:
    offset: int  # bytes before the vertices
    form: str  # ascii, binary_little_endian, binary_big_endian
    n_vertices: int
    properties: tuple[tuple[str, str], ...]  # name, numpy type without byte order


def _open_ply(path: Path) -> CloudFile:
    header = _ply_header(path)

    def chunks() -> Iterator[Float]:
        if header.form == "ascii":
            yield from _ascii_vertices(path, header)
        else:
            yield from _binary_vertices(path, header)

    kinds = dict(header.properties)
    return CloudFile(path, header.n_vertices, chunks, single_precision="f4" in {kinds[axis] for axis in "xyz"})


def _ply_header(path: Path) -> _PlyHeader:
    form, n_vertices, element = "", -1, ""
    properties: list[tuple[str, str]] = []
    with path.open("rb") as stream:
        if stream.readline(8).strip() != b"ply":
            raise ReferenceFormatError(f"{path}, line 1: not a PLY file")
        for number in range(2, MAX_HEADER_LINES):
            line = stream.readline(1_000)
            words = line.decode("latin-1").split()
            if not line or words[:1] == ["end_header"]:
                break
            if words[:1] == ["format"] and len(words) > 1:
                form = words[1]
            elif words[:1] == ["element"] and len(words) == 3:
                if n_vertices < 0 and words[1] != "vertex":
                    raise ReferenceFormatError(f"{path}, line {number}: the first element must be `vertex`")
                element = words[1]
                if element == "vertex":
                    n_vertices = int(words[2]) if words[2].isdecimal() else -1
            elif words[:1] == ["property"] and element == "vertex":
                if len(words) != 3 or words[1] not in PLY_TYPES:
                    raise ReferenceFormatError(
                        f"{path}, line {number}: unknown vertex property {' '.join(words[1:])!r}"
                    )
                properties.append((words[2], PLY_TYPES[words[1]]))
        offset = stream.tell()
        complete = words[:1] == ["end_header"]
    if not complete or n_vertices < 0 or form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ReferenceFormatError(f"{path}: incomplete PLY header")
    names = [name for name, _ in properties]
    if any(axis not in names for axis in "xyz") or len(set(names)) < len(names):
        raise ReferenceFormatError(f"{path}: vertices need one property each of x, y and z; found {', '.join(names)}")
    least = sum(np.dtype(kind).itemsize for _, kind in properties) if form != "ascii" else 2 * len(properties)
    if n_vertices * least > path.stat().st_size - offset + 1:  # the last line may lack its end
        raise ReferenceFormatError(f"{path}: ends before its {n_vertices} vertices")
    return _PlyHeader(offset, form, n_vertices, tuple(properties))


def _binary_vertices(path: Path, header: _PlyHeader) -> Iterator[Float]:
    order = "<" if header.form == "binary_little_endian" else ">"
    vertex = np.dtype([(name, order + kind) for name, kind in header.properties])
    if path.stat().st_size < header.offset + header.n_vertices * vertex.itemsize:
        raise ReferenceFormatError(f"{path}: ends before its {header.n_vertices} vertices")
    for start in range(0, header.n_vertices, CHUNK_POINTS):
        count = min(CHUNK_POINTS, header.n_vertices - start)
        values = np.fromfile(path, vertex, count, offset=header.offset + start * vertex.itemsize)
        yield np.stack([values[axis].astype(float) for axis in "xyz"], axis=1)


def _ascii_vertices(path: Path, header: _PlyHeader) -> Iterator[Float]:
    names = [name for name, _ in header.properties]
    columns = [names.index(axis) for axis in "xyz"]
    with path.open("rb") as stream:
        stream.seek(header.offset)
        for start in range(0, header.n_vertices, CHUNK_POINTS):
            count = min(CHUNK_POINTS, header.n_vertices - start)
            try:
                values = np.loadtxt(stream, usecols=columns, max_rows=count, ndmin=2)
            except (ValueError, IndexError) as error:
                raise ReferenceFormatError(f"{path}: damaged vertices after number {start} ({error})") from None
            if len(values) < count:
                raise ReferenceFormatError(f"{path}: ends before its {header.n_vertices} vertices")
            yield values
