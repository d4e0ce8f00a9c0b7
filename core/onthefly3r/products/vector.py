"""The camera positions as an ESRI shapefile (PointZ)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..files.atomic import replacing
from .rows import CameraRow

# name (ASCII, at most 10 characters), dBASE type, width, decimals
FIELDS: tuple[tuple[str, str, int, int], ...] = (
    ("image", "C", 254, 0),
    ("number", "N", 9, 0),
    ("status", "C", 10, 0),
    ("reason", "C", 254, 0),
    ("x", "N", 18, 4),
    ("y", "N", 18, 4),
    ("z", "N", 14, 4),
    ("omega", "N", 13, 6),
    ("phi", "N", 13, 6),
    ("kappa", "N", 13, 6),
    ("yaw", "N", 13, 6),
    ("pitch", "N", 13, 6),
    ("roll", "N", 13, 6),
    ("gps_x", "N", 18, 4),
    ("gps_y", "N", 18, 4),
    ("gps_z", "N", 14, 4),
    ("dx", "N", 14, 4),
    ("dy", "N", 14, 4),
    ("dz", "N", 14, 4),
    ("d_h", "N", 14, 4),
    ("d_3d", "N", 14, 4),
    ("sig_h", "N", 10, 4),
    ("sig_v", "N", 10, 4),
    ("sd_h", "N", 10, 4),
    ("sd_v", "N", 10, 4),
    ("sd_deg", "N", 10, 5),
    ("rtk", "N", 4, 0),
    ("used", "L", 1, 0),
    ("retries", "N", 6, 0),
    ("batch", "N", 9, 0),
    ("part", "N", 4, 0),
    ("t_utc", "C", 24, 0),
    ("cam", "C", 120, 0),
)


def write_cameras(path: Path, rows: Iterable[CameraRow], crs: str | None) -> int:
    """Write `path` (.shp) with .shx, .dbf, .cpg and .prj beside it and return the number of points.

    Placed photographs lie where they were placed, rejected ones at their tagged position; rejected ones without a
    position are left out. The .prj is ESRI WKT 1 of the horizontal part only, as the format demands.

    Args:
        path: final name, ending in .shp.
        rows: in capture order; coordinates in `crs`.
        crs: anything pyproj reads; None (local frame) writes no .prj and removes an old one.
    """
    import shapefile

    count = 0
    with replacing(path, companions=(".shx", ".dbf", ".cpg", ".prj")) as temporary:
        with shapefile.Writer(str(temporary), shapeType=shapefile.POINTZ, encoding="utf-8") as writer:
            for name, kind, width, decimals in FIELDS:
                writer.field(name, kind, size=width, decimal=decimals)
            for row in rows:
                position = row.position
                if position is None:
                    continue
                writer.pointz(*position)
                writer.record(*_record(row))
                count += 1
        write_companions(temporary, path, crs)
    return count


def write_companions(temporary: Path, path: Path, crs: str | None) -> None:
    """Write the encoding and the CRS beside a shapefile that becomes `path`; without a CRS an earlier one goes."""
    temporary.with_suffix(".cpg").write_text("UTF-8", encoding="ascii")
    if crs is None:
        path.with_suffix(".prj").unlink(missing_ok=True)
    else:
        temporary.with_suffix(".prj").write_text(esri_wkt(crs), encoding="utf-8")


def esri_wkt(crs: str) -> str:
    """Return what a .prj holds: ESRI WKT 1 of the horizontal part."""
    from pyproj import CRS

    return str(CRS.from_user_input(crs).to_2d().to_wkt("WKT1_ESRI"))


def _record(row: CameraRow) -> list[object]:
    values = ((getattr(row, name), name, kind, width) for name, kind, width, _ in FIELDS)
    return [fit_text(value, width, name == "image") if kind == "C" else value for value, name, kind, width in values]


def fit_text(text: str, width: int, keep_end: bool) -> str:
    """Return text of at most `width` bytes of UTF-8, with ? for what cannot be written.

    Of a file name the end is kept, because that tells names apart.
    """
    data = text.strip().encode("utf-8", errors="replace")
    if len(data) > width:
        data = b"..." + data[3 - width :] if keep_end else data[: width - 3] + b"..."
    return data.decode("utf-8", errors="ignore")
