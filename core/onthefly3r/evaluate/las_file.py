"""LAS and LAZ files from anywhere: the sizes they state are checked before anything is allocated."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import ReferenceFormatError
from ..geometry.arrays import Float

CHUNK_POINTS = 1_000_000
MAX_RECORDS = 10_000  # variable length records of a file
MAX_COMPRESSION = 20_000  # times: no LAZ file holds more points for its size, however alike they are
LASZIP_USER, LASZIP_RECORD = b"laszip encoded", 22204
VARIABLE_CHUNKS = 0xFFFFFFFF
LAYERED = 3  # compressor of the point formats 6 to 10
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of POINT14, RGB14, RGBNIR14, WAVEPACKET14
BYTES14 = 14  # one layer for each extra byte
VLR_HEADER, EVLR_HEADER = 54, 60


@dataclass(frozen=True)
class LasFile:
    """What the header of a LAS or LAZ file states."""

    path: Path
    n_points: int
    bounds: Float  # (2, 3) lowest and highest coordinates
    crs: Any  # pyproj.CRS, None where the file states none that PROJ knows

    def chunks(self) -> Iterator[Float]:
        """Yield the coordinates (N, 3) float64 of at most a million points each; raises `ReferenceFormatError`."""
        with _reading(self.path), _opened(self.path) as reader:
            for chunk in reader.chunk_iterator(CHUNK_POINTS):
                yield np.stack([np.asarray(chunk.x), np.asarray(chunk.y), np.asarray(chunk.z)], axis=1)


def open_las(path: Path) -> LasFile:
    """Look at the header of a LAS or LAZ file; raises `ReferenceFormatError` when it contradicts the file's size."""
    with _reading(path):
        with path.open("rb") as stream:
            _require_sizes(stream, path.stat().st_size)
        with _opened(path) as reader:
            header = reader.header
            bounds = np.array([header.mins, header.maxs], float)
            return LasFile(path, int(header.point_count), bounds, _crs(header))


def _opened(path: Path) -> Any:
    """Open a checked file; the decoder in one thread, since the parallel one believes the table of chunks."""
    import laspy

    return laspy.open(path, laz_backend=laspy.LazBackend.Lazrs)


def _crs(header: Any) -> Any:
    """Return the CRS of a header; one that PROJ cannot read counts as none."""
    try:
        return header.parse_crs()
    except Exception:  # laspy hands the file's text to PROJ, which knows many ways to fail
        return None


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes laspy and its decoder raise into our own error."""
    try:
        yield
    except (ReferenceFormatError, GeneratorExit, KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except OSError as error:
        raise ReferenceFormatError(f"{path}: cannot be read ({error.strerror or error})") from None
    except BaseException as error:
        # The decoder's own panics derive from BaseException alone.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise ReferenceFormatError(f"{path}: damaged, or not a LAS or LAZ file ({error})") from None


def _require_sizes(stream: BinaryIO, size: int) -> None:
    """Raise `ValueError` when counts and offsets of the header do not fit the file (ASPRS LAS 1.4 R15, LASzip)."""
    head = stream.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise ValueError("it has no LAS header")
    minor, header_size = head[25], _number("<H", head, 94)
    offset, n_vlrs, form, length, n_points = struct.unpack_from("<IIBHI", head, 96)
    if minor >= 4:
        if len(head) < 375:
            raise ValueError("its header is cut off")
        first_evlr, n_evlrs, n_points = struct.unpack_from("<QIQ", head, 235)
        _require_evlrs(stream, size, first_evlr, n_evlrs)
    if not 227 <= header_size <= offset <= size:
        raise ValueError(f"its points begin at byte {offset} of {size}, after a header of {header_size}")
    if length < 20:
        raise ValueError(f"its points have {length} bytes")
    compression = _laszip(stream, header_size, offset, n_vlrs)
    compressed = bool(form & 0xC0)
    if compressed != (compression is not None):
        raise ValueError("its header and its records disagree on whether it is compressed")
    room = size - offset
    if not compressed:
        if n_points * length > room:
            raise ValueError(f"{n_points} points of {length} bytes do not fit into {room} bytes")
        return
    if n_points * length > MAX_COMPRESSION * room:
        raise ValueError(f"{n_points} points cannot have been compressed into {room} bytes")
    _require_chunks(stream, size, offset, n_points, length, compression or b"")


def _laszip(stream: BinaryIO, header_size: int, offset: int, n_vlrs: int) -> bytes | None:
    """Walk the records between header and points; return the data of the one that LASzip needs."""
    if n_vlrs > MAX_RECORDS:
        raise ValueError(f"{n_vlrs} records are too many")
    found, at = None, header_size
    for _ in range(n_vlrs):
        stream.seek(at)
        head = stream.read(VLR_HEADER)
        if len(head) < VLR_HEADER:
            raise ValueError("its records are cut off")
        user, record, length = head[2:18].rstrip(b"\0"), _number("<H", head, 18), _number("<H", head, 20)
        at += VLR_HEADER + length
        if at > offset:
            raise ValueError("its records reach into its points")
        if (user, record) == (LASZIP_USER, LASZIP_RECORD):
            found = stream.read(length)
    return found


def _require_evlrs(stream: BinaryIO, size: int, at: int, count: int) -> None:
    if count > MAX_RECORDS:
        raise ValueError(f"{count} extended records are too many")
    for _ in range(count):
        stream.seek(min(at, size))
        head = stream.read(EVLR_HEADER)
        if len(head) < EVLR_HEADER:
            raise ValueError("its extended records are cut off")
        at += EVLR_HEADER + int(_number("<Q", head, 20))
        if at > size:
            raise ValueError("its extended records reach beyond the end of the file")


def _require_chunks(stream: BinaryIO, size: int, offset: int, n_points: int, length: int, laszip: bytes) -> None:
    """Check LASzip's own record and its table of chunks, of which each begins with one point as it is."""
    if len(laszip) < 34:
        raise ValueError("its LASzip record is cut off")
    chunk_size, n_items = _number("<I", laszip, 12), _number("<H", laszip, 32)
    if len(laszip) < 34 + 6 * n_items:
        raise ValueError("its LASzip record is cut off")
    items = [struct.unpack_from("<HH", laszip, 34 + 6 * k) for k in range(n_items)]
    if sum(size for _, size in items) != length:
        raise ValueError(f"its points have {length} bytes, its compressed items another number")
    if n_points == 0:
        return
    stream.seek(offset)
    table = _number("<q", stream.read(8), 0)
    if table == -1:
        stream.seek(size - 8)
        table = _number("<q", stream.read(8), 0)
    if not offset + 8 <= table <= size - 8:
        raise ValueError("its table of chunks lies outside the file")
    stream.seek(table)
    n_chunks = _number("<I", stream.read(8), 4)
    if n_chunks * length > size - offset:
        raise ValueError(f"{n_chunks} chunks do not fit into the file")
    if chunk_size != VARIABLE_CHUNKS and n_points > n_chunks * chunk_size:
        raise ValueError(f"{n_points} points do not fit into {n_chunks} chunks of {chunk_size}")
    if _number("<H", laszip, 0) == LAYERED:
        _require_layers(stream, offset + 8, table, n_chunks, length, items)


def _require_layers(
    stream: BinaryIO, at: int, end: int, n_chunks: int, length: int, items: list[tuple[int, int]]
) -> None:
    """Check the sizes that each chunk states for its layers: the decoder allocates them as they stand there."""
    n_layers = sum(size if kind == BYTES14 else LAYERS.get(kind, 0) for kind, size in items)
    for number in range(n_chunks):
        stream.seek(at + length)
        head = stream.read(4 + 4 * n_layers)
        if len(head) < 4 + 4 * n_layers:
            raise ValueError(f"its chunk {number} is cut off")
        at += length + len(head) + sum(struct.unpack_from(f"<{n_layers}I", head, 4))
        if at > end:
            raise ValueError(f"its chunk {number} reaches beyond the chunks")


def _number(kind: str, data: bytes, at: int) -> int:
    return int(struct.unpack_from(kind, data, at)[0])
