"""The part of the ground that a cloud is cut to, read from GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.arrays import Float
from ..geometry.geodesy import projected_from_geographic
from ..records import CloudTile

MAX_FILE_BYTES = 64 * 1024 * 1024
MAX_EDGE_DEG = 0.001  # longer edges get points between: they are straight in longitude and latitude
MAX_POINTS_PER_EDGE = 1000


@dataclass(frozen=True)
class Boundary:
    """An area as rings in the export frame; a point inside an odd number of rings is in the area."""

    rings: tuple[Float, ...]  # each (N, 2) easting, northing, m

    def contains(self, points: Float) -> Float:
        """Return which points (N, 2 or more) lie in the area."""
        inside = np.zeros(len(points), bool)
        for ring in self.rings:
            low, high = ring.min(axis=0), ring.max(axis=0)
            near = np.nonzero(((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1))[0]
            if near.size:
                inside[near] ^= in_ring(points[near, :2], ring)
        return inside


def in_ring(points: Float, ring: Float) -> Float:
    """Return which points (N, 2) lie inside a ring (M, 2), by crossing parity."""
    inside = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        crosses = (y0 > points[:, 1]) != (y1 > points[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            at_x = x0 + (points[:, 1] - y0) * (x1 - x0) / (y1 - y0)
        inside ^= crosses & (points[:, 0] < at_x)
    return inside


def read_boundary(path: Path, crs: str) -> Boundary:
    """Read the polygons of a GeoJSON file (RFC 7946: WGS 84 longitude, latitude) into a projected CRS.

    Raises `InputError` when the file is missing or holds no polygon.
    """
    to_projected = projected_from_geographic(crs)
    projected = [np.stack(to_projected.transform(*_densified(ring).T), axis=-1) for ring in read_rings(path)]
    if not all(np.isfinite(ring).all() for ring in projected):
        raise InputError(f"boundary {path} reaches beyond where {crs} can be used")
    return Boundary(tuple(projected))


def read_rings(path: Path) -> list[Float]:
    """Return the rings (N, 2) of a GeoJSON file in longitude and latitude; raises `InputError`."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError(f"it is larger than {MAX_FILE_BYTES // 2**20} MiB")
        told = json.loads(path.read_text(encoding="utf-8"))
        rings = [np.array([point[:2] for point in ring], float) for ring in _rings(told)]
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"boundary {path} is no GeoJSON of polygons ({error})") from error
    rings = [ring for ring in rings if ring.ndim == 2 and len(ring) >= 4]
    if not rings:
        raise InputError(f"boundary {path} holds no polygon")
    if any((np.abs(ring).max(axis=0) > (180.0, 90.0)).any() for ring in rings):
        raise InputError(f"boundary {path} is not in longitude and latitude (WGS 84), as GeoJSON must be")
    return rings


def clipped(tiles: Iterable[CloudTile], boundary: Boundary) -> Iterator[CloudTile]:
    """Yield the tiles without what lies outside the boundary; empty tiles are left out."""
    for tile in tiles:
        inside = boundary.contains(tile.points)
        if inside.any():
            yield replace(
                tile,
                points=tile.points[inside],
                rgb=tile.rgb[inside],
                confidence=tile.confidence[inside],
                source=tile.source[inside],
                batch=tile.batch[inside],
                views=tile.views[inside],
            )


def _rings(data: dict[str, Any]) -> Iterator[list[Any]]:
    kind = data["type"]
    if kind == "FeatureCollection":
        for feature in data["features"]:
            yield from _rings(feature)
    elif kind == "Feature":
        if data["geometry"] is not None:
            yield from _rings(data["geometry"])
    elif kind == "GeometryCollection":
        for geometry in data["geometries"]:
            yield from _rings(geometry)
    elif kind == "Polygon":
        yield from data["coordinates"]
    elif kind == "MultiPolygon":
        for polygon in data["coordinates"]:
            yield from polygon


def _densified(ring: Float) -> Float:
    parts = []
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        longest = float(np.abs(end - start).max())
        steps = int(np.clip(np.ceil(longest / MAX_EDGE_DEG), 1, MAX_POINTS_PER_EDGE))
        parts.append(start + (end - start) * (np.arange(steps)[:, None] / steps))
    return np.vstack(parts)
