"""The indexes that QGIS makes beside a LAS or LAZ file and then shows in its place; which of them came from that file.

Standard library only: QGIS imports this module in its own process.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
from dataclasses import dataclass
from pathlib import Path

from .strict_json import loads

HEADER_BYTES = 375  # of LAS 1.4
LEGACY_HEADER_BYTES = 227
MAX_EPT_BYTES = 2**20
SAME_M = 0.01  # bounds are rounded to the resolution of each file
_EPT_PARTS = ("ept-data", "ept-hierarchy", "ept-sources")


@dataclass(frozen=True)
class Extent:
    """How many points a cloud has, and where: lowest and highest x, y, z."""

    points: int
    bounds: tuple[float, ...]

    def is_same(self, other: Extent) -> bool:
        """Return whether both are of one cloud, as well as that can be told."""
        if len(self.bounds) != len(other.bounds):
            return False
        near = (abs(a - b) <= SAME_M for a, b in zip(self.bounds, other.bounds))  # noqa: B905 - Python 3.9 of QGIS
        return self.points == other.points and all(near)


@dataclass(frozen=True)
class PointIndex:
    """A COPC file or an EPT folder beside a cloud."""

    path: Path

    def extent(self) -> Extent | None:
        """Return what the index says of its points, None where it says nothing that can be read."""
        return las_extent(self.path) if self.path.is_file() else _ept_extent(self.path / "ept.json")

    def remove(self) -> None:
        """Remove the index; in an EPT folder, only what belongs to one."""
        with contextlib.suppress(OSError):
            if not self.path.is_dir() or self.path.is_symlink():
                self.path.unlink()
                return
            for part in _EPT_PARTS:
                shutil.rmtree(self.path / part, ignore_errors=True)
            for name in ("ept-build.json", "ept.json"):
                (self.path / name).unlink(missing_ok=True)
            self.path.rmdir()


def indexes_beside(cloud: Path) -> list[PointIndex]:
    """Return what QGIS would show in place of a cloud, whatever it was made from."""
    places = (cloud.with_name(f"{cloud.stem}.copc.laz"), cloud.with_name(f"ept_{cloud.stem}"))
    return [PointIndex(place) for place in places if os.path.lexists(place)]


def indexes_of(cloud: Path) -> list[PointIndex]:
    """Return the indexes beside a cloud that were made from it: as many points, within the same bounds."""
    extent = las_extent(cloud)
    found = ((index, index.extent()) for index in indexes_beside(cloud))
    return [index for index, theirs in found if extent is not None and theirs is not None and theirs.is_same(extent)]


def las_extent(path: Path) -> Extent | None:
    """Return what the header of a LAS or LAZ file says, None for any other file."""
    try:
        with path.open("rb") as stream:
            header = stream.read(HEADER_BYTES)
        if len(header) < LEGACY_HEADER_BYTES or header[:4] != b"LASF":
            return None
        (count,) = struct.unpack_from("<I", header, 107)
        if header[25] >= 4 and len(header) == HEADER_BYTES:
            (count,) = struct.unpack_from("<Q", header, 247)
        max_x, min_x, max_y, min_y, max_z, min_z = struct.unpack_from("<6d", header, 179)
        return Extent(count, (min_x, min_y, min_z, max_x, max_y, max_z))
    except OSError:
        return None


def _ept_extent(path: Path) -> Extent | None:
    try:
        if path.stat().st_size > MAX_EPT_BYTES:
            return None
        told = loads(path.read_text(encoding="utf-8"))
        bounds = tuple(float(value) for value in told["boundsConforming"])
        return Extent(int(told["points"]), bounds) if len(bounds) == 6 else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
