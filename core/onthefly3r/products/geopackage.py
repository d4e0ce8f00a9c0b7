"""`survey.gpkg`: cameras, rejected photographs and footprints in one GeoPackage (OGC 12-128r18)."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..files.atomic import replacing
from .footprints import Footprint
from .rows import CameraRow
from .vector import FIELDS

APPLICATION_ID, USER_VERSION = 0x47504B47, 10300  # "GPKG", version 1.3
UNDEFINED = -1  # the standard's number of an undefined Cartesian reference system
TYPES = {"C": "TEXT", "N": "REAL", "L": "BOOLEAN"}
REFERENCES = (
    (UNDEFINED, "NONE", -1, "undefined", "Undefined Cartesian"),
    (0, "NONE", 0, "undefined", "Undefined geographic"),
)
SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT PRIMARY KEY REFERENCES gpkg_contents(table_name),
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL REFERENCES gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL);
"""


@dataclass(frozen=True)
class _Table:
    name: str
    geometry: str  # POINT or POLYGON
    fields: tuple[tuple[str, str], ...]  # name, SQL type
    rows: tuple[tuple[Sequence[tuple[float, ...]] | None, tuple[Any, ...]], ...]  # vertices, values


def write_geopackage(
    path: Path, rows: Iterable[CameraRow], footprints: Iterable[Footprint], crs: str | None
) -> dict[str, int]:
    """Write the layers cameras, rejected and footprints, and return the number of features of each.

    Rejected photographs without a position are kept without geometry. Fields are those of the shapefiles, without their
    limits. `crs` is anything pyproj reads; None gives the undefined Cartesian reference system.
    """
    listed = list(rows)
    tables = (
        _cameras("cameras", [row for row in listed if row.status == "placed"]),
        _cameras("rejected", [row for row in listed if row.status == "rejected"]),
        _footprints(footprints),
    )
    with replacing(path) as temporary:
        temporary.unlink(missing_ok=True)
        connection = sqlite3.connect(temporary)
        try:
            connection.executescript(f"PRAGMA application_id={APPLICATION_ID};PRAGMA user_version={USER_VERSION};")
            connection.executescript(SCHEMA)
            reference = _references(connection, crs)
            for table in tables:
                _write(connection, table, reference)
            connection.commit()
        finally:
            connection.close()
    return {table.name: len(table.rows) for table in tables}


def _references(connection: sqlite3.Connection, crs: str | None) -> int:
    """Write the reference systems and return the number of that of the layers."""
    from pyproj import CRS

    lines = [(name, number, body, code, definition, "") for number, body, code, definition, name in REFERENCES]
    lines.append(("WGS 84", 4326, "EPSG", 4326, str(CRS.from_epsg(4326).to_wkt("WKT1_GDAL")), ""))
    number = UNDEFINED
    if crs is not None:
        system = CRS.from_user_input(crs).to_2d()
        code = system.to_epsg()
        number = code or 100_000
        body = "EPSG" if code else "NONE"
        lines.append((system.name, number, body, number, str(system.to_wkt("WKT1_GDAL")), ""))
    connection.executemany("INSERT OR REPLACE INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", lines)
    return number


def _cameras(name: str, rows: Sequence[CameraRow]) -> _Table:
    fields = tuple((field, TYPES[kind]) for field, kind, _, _ in FIELDS)
    values = tuple(
        (None if row.position is None else [row.position], tuple(_plain(getattr(row, field)) for field, _ in fields))
        for row in rows
    )
    return _Table(name, "POINT", fields, values)


def _footprints(footprints: Iterable[Footprint]) -> _Table:
    fields = (("image", "TEXT"), ("number", "INTEGER"), ("gsd_m", "REAL"), ("area_m2", "REAL"), ("overlap", "INTEGER"))
    values = []
    for item in footprints:
        ring = [tuple(float(v) for v in corner) for corner in item.outline]
        values.append(([*ring, ring[0]], tuple(_plain(getattr(item, field)) for field, _ in fields)))
    return _Table("footprints", "POLYGON", fields, tuple(values))


def _write(connection: sqlite3.Connection, table: _Table, reference: int) -> None:
    columns = ", ".join(f'"{name}" {kind}' for name, kind in table.fields)
    connection.execute(
        f'CREATE TABLE "{table.name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {table.geometry}, {columns})'
    )
    marks = ", ".join("?" * (len(table.fields) + 1))
    names = ", ".join(["geom", *(f'"{name}"' for name, _ in table.fields)])
    connection.executemany(
        f'INSERT INTO "{table.name}" ({names}) VALUES ({marks})',  # noqa: S608 - names are our own
        [(_blob(vertices, table.geometry, reference), *values) for vertices, values in table.rows],
    )
    points = [vertex for vertices, _ in table.rows for vertex in vertices or ()]
    bounds = [f(p[k] for p in points) for f in (min, max) for k in (0, 1)] if points else [None] * 4
    connection.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
        "VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (table.name, table.name, *bounds, reference),
    )
    has_z = int(table.geometry == "POINT")
    connection.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, ?, 0)",
        (table.name, table.geometry, reference, has_z),
    )


def _blob(vertices: Sequence[tuple[float, ...]] | None, geometry: str, reference: int) -> bytes | None:
    """Return GeoPackage binary: its header without an envelope, then little-endian WKB (ISO)."""
    if vertices is None:
        return None
    header = b"GP" + struct.pack("<BBi", 0, 1, reference)
    if geometry == "POINT":
        return header + struct.pack("<BI3d", 1, 1001, *vertices[0])
    ring = b"".join(struct.pack("<2d", *vertex[:2]) for vertex in vertices)
    return header + struct.pack("<BIII", 1, 3, 1, len(vertices)) + ring


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", errors="replace").decode("utf-8")
    return value.item() if hasattr(value, "item") else value
