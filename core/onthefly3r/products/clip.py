"""The part of the ground that a cloud is cut to, read from GeoJSON."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..files.strict_json import loads
from ..geometry.arrays import Bool, Float
from ..geometry.geodesy import projected_from_geographic
from ..records import CloudTile, Shot

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

MAX_FILE_BYTES = 64 * 1024 * 1024
MAX_EDGE_DEG = 0.001  # longer edges get points between: they are straight in longitude and latitude
MAX_EDGES = 20_000  # along the longer side of the area: larger areas get fewer points between
FAR_DEG = 0.05  # some 5 km: a boundary that far from every photograph is that of another place
WGS84_NAMES = ("crs84", "epsg::4326", "epsg:4326", "epsg::4979")


@dataclass(frozen=True)
class Boundary:
    """An area in the export frame: the union of polygons, which may have holes."""

    area: MultiPolygon | Polygon  # easting, northing, m

    def contains(self, points: Float) -> Bool:
        """Return which points (N, 2 or more) lie in the area."""
        import shapely

        shapely.prepare(self.area)
        return np.asarray(shapely.contains_xy(self.area, points[:, 0], points[:, 1]))


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

    A point is in the area when any of the polygons holds it; a hole counts for its own polygon only. Raises
    `InputError` when the file is missing or holds no polygon.
    """
    import shapely

    area = _union(read_polygons(path))
    west, south, east, north = area.bounds
    edge_deg = max(MAX_EDGE_DEG, max(east - west, north - south) / MAX_EDGES)
    to_projected = projected_from_geographic(crs)

    def project(lonlat: Float) -> Float:
        return np.stack(to_projected.transform(*lonlat.T), axis=-1)

    projected = shapely.transform(shapely.segmentize(area, edge_deg), project)
    if not np.isfinite(shapely.get_coordinates(projected)).all():
        raise InputError(f"boundary {path} reaches beyond where {crs} can be used")
    return Boundary(shapely.make_valid(projected))


def read_polygons(path: Path) -> list[Polygon]:
    """Return the polygons of a GeoJSON file in longitude and latitude; raises `InputError`."""
    import shapely

    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError(f"it is larger than {MAX_FILE_BYTES // 2**20} MiB")
        told = loads(path.read_text(encoding="utf-8-sig"))
        _require_wgs84(told)
        rings_of = [[np.array([point[:2] for point in ring], float) for ring in polygon] for polygon in _polygons(told)]
        rings_of = [rings for rings in rings_of if rings and all(r.ndim == 2 and len(r) >= 4 for r in rings)]
        if not all(np.isfinite(ring).all() for rings in rings_of for ring in rings):
            raise ValueError("it holds a coordinate that is not finite")
        polygons = [shapely.Polygon(rings[0], rings[1:]) for rings in rings_of]
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        OverflowError,
        RecursionError,
        shapely.errors.ShapelyError,
    ) as error:
        raise InputError(f"boundary {path} is no GeoJSON of polygons ({error}); save it as GeoJSON") from error
    if not polygons:
        raise InputError(f"boundary {path} holds no polygon; draw the area as a polygon and save it as GeoJSON")
    if any((np.abs(ring).max(axis=0) > (180.0, 90.0)).any() for rings in rings_of for ring in rings):
        raise InputError(f"boundary {path} is not in longitude and latitude (WGS 84), as GeoJSON must be")
    return polygons


def require_boundary_near(path: Path, shots: Sequence[Shot]) -> None:
    """Raise `InputError` when the boundary is damaged, or far from every photograph that has a position."""
    import shapely

    area = _union(read_polygons(path))
    fixes = [shot.gps for shot in shots if shot.gps is not None]
    if not fixes:
        return
    points = shapely.points([(fix.lon_deg, fix.lat_deg) for fix in fixes])
    nearest_deg = float(shapely.distance(area, points).min())
    if nearest_deg > FAR_DEG:
        west, south, east, north = area.bounds
        raise InputError(
            f"boundary {path} lies elsewhere: it spans longitude {west:.4f} to {east:.4f} and latitude {south:.4f} to "
            f"{north:.4f}, and the nearest photograph is {nearest_deg:.2f} degrees away. Longitude comes first in "
            "GeoJSON; name the boundary of this survey or leave it out"
        )


def clipped(tiles: Iterable[CloudTile], boundary: Boundary) -> Iterator[CloudTile]:
    """Yield the tiles without what lies outside the boundary; empty tiles are left out."""
    for tile in tiles:
        inside = boundary.contains(tile.points)
        if inside.any():
            yield tile.only(inside)


def _union(polygons: Sequence[Polygon]) -> Polygon | MultiPolygon:
    """Return the area of any of the polygons; outlines that cross themselves enclose what lies in their loops."""
    import shapely

    return shapely.union_all(shapely.make_valid(polygons))


def _require_wgs84(told: Any) -> None:
    """Refuse the CRS member of old GeoJSON files when it names another CRS (RFC 7946 knows only WGS 84)."""
    named = told.get("crs") if isinstance(told, dict) else None
    if named is None:
        return
    name = str(named.get("properties", {}).get("name", "")) if isinstance(named, dict) else ""
    if not name.casefold().endswith(WGS84_NAMES):
        raise ValueError(f"it is in the CRS {name or named!r} instead of WGS 84 longitude, latitude")


def _polygons(data: Any) -> Iterator[list[Any]]:
    """Yield the coordinates of each polygon: its outline and its holes."""
    kind = data["type"]
    if kind == "FeatureCollection":
        for feature in data["features"]:
            yield from _polygons(feature)
    elif kind == "Feature":
        if data["geometry"] is not None:
            yield from _polygons(data["geometry"])
    elif kind == "GeometryCollection":
        for geometry in data["geometries"]:
            yield from _polygons(geometry)
    elif kind == "Polygon":
        yield data["coordinates"]
    elif kind == "MultiPolygon":
        yield from data["coordinates"]
