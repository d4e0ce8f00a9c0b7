"""`survey.gpkg`: cameras, rejected photographs, control and coverage in one styled GeoPackage (OGC 12-128r18)."""

from __future__ import annotations

import math
import sqlite3
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..files.atomic import replacing
from ..records import ControlResidual
from .coverage import covered, weak_areas
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
# Where QGIS looks for the style of a layer (its own convention, see QgsOgrProvider).
STYLES_SCHEMA = """
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT, f_table_catalog TEXT(256), f_table_schema TEXT(256),
  f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
  useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
  update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')));
INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('layer_styles', 'attributes', 'layer_styles');
"""
STYLES = Path(__file__).with_name("styles")
CONTROL_FIELDS = (
    ("label", "TEXT"),
    ("role", "TEXT"),
    ("images", "INTEGER"),
    ("east_m", "REAL"),
    ("north_m", "REAL"),
    ("up_m", "REAL"),
    ("sigma_h_m", "REAL"),
    ("sigma_v_m", "REAL"),
    ("marks_px", "REAL"),
)
Xyz = tuple[float, float, float]


@dataclass(frozen=True)
class _Table:
    name: str
    geometry: str  # POINT (with a height), POLYGON or MULTIPOLYGON
    fields: tuple[tuple[str, str], ...]  # name, SQL type
    rows: tuple[tuple[Any, tuple[Any, ...]], ...]  # shapely geometry or None, values


def write_geopackage(
    path: Path,
    rows: Iterable[CameraRow],
    footprints: Iterable[Footprint],
    crs: str | None,
    *,
    photographs: Mapping[int, Path] | None = None,
    control: Sequence[tuple[ControlResidual, Xyz]] = (),
) -> dict[str, int]:
    """Write the layers of a survey with their styles, and return the number of features of each.

    Layers are cameras, rejected, footprints, coverage (all footprints as one), fly_again (what too few photographs
    show) and, when there is any, control. Rejected photographs without a position are kept without geometry. Fields
    are those of the shapefiles, without their limits, and the path of the photograph.

    Args:
        path: final name, ending in .gpkg.
        rows: in capture order; coordinates in `crs`.
        footprints: in `crs`.
        crs: anything pyproj reads; None gives the undefined Cartesian reference system.
        photographs: their files, by number (shot index + 1).
        control: control points and checkpoints, each with its coordinates in `crs`; NaN for an unknown height.
    """
    listed, outlines = list(rows), list(footprints)
    files = photographs or {}
    tables = [
        _cameras("cameras", [row for row in listed if row.status == "placed"], files),
        _cameras("rejected", [row for row in listed if row.status == "rejected"], files),
        _footprints(outlines),
        _coverage(outlines),
        _weak(outlines),
        *([_control(control)] if control else []),
    ]
    with replacing(path) as temporary:
        temporary.unlink(missing_ok=True)
        connection = sqlite3.connect(temporary)
        try:
            connection.executescript(f"PRAGMA application_id={APPLICATION_ID};PRAGMA user_version={USER_VERSION};")
            connection.executescript(SCHEMA)
            reference = _references(connection, crs)
            for table in tables:
                _write(connection, table, reference)
            _write_styles(connection, tables)
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


def _cameras(name: str, rows: Sequence[CameraRow], files: Mapping[int, Path]) -> _Table:
    from shapely import Point

    fields = tuple((field, TYPES[kind]) for field, kind, _, _ in FIELDS)
    values = tuple(
        (
            None if row.position is None else Point(row.position),
            (*(_plain(getattr(row, field)) for field, _ in fields), _file(files.get(row.number))),
        )
        for row in rows
    )
    return _Table(name, "POINT", (*fields, ("path", "TEXT")), values)


def _file(path: Path | None) -> str | None:
    return None if path is None else str(_plain(str(path.absolute())))


def _footprints(footprints: Sequence[Footprint]) -> _Table:
    from shapely import Polygon

    fields = (("image", "TEXT"), ("number", "INTEGER"), ("gsd_m", "REAL"), ("area_m2", "REAL"), ("overlap", "INTEGER"))
    values = [
        (Polygon(item.outline), tuple(_plain(getattr(item, field)) for field, _ in fields)) for item in footprints
    ]
    return _Table("footprints", "POLYGON", fields, tuple(values))


def _coverage(footprints: Sequence[Footprint]) -> _Table:
    union = covered(footprints)
    fields = (("photographs", "INTEGER"), ("area_m2", "REAL"))
    values = ((union, (len(footprints), float(union.area))),) if footprints else ()
    return _Table("coverage", "MULTIPOLYGON", fields, values)


def _weak(footprints: Sequence[Footprint]) -> _Table:
    fields = (("photographs", "INTEGER"), ("area_m2", "REAL"), ("reason", "TEXT"))
    values = [(weak.area, (weak.photographs, float(weak.area.area), weak.reason)) for weak in weak_areas(footprints)]
    return _Table("fly_again", "POLYGON", fields, tuple(values))


def _control(points: Sequence[tuple[ControlResidual, Xyz]]) -> _Table:
    from shapely import Point

    values = []
    for point, (x, y, z) in points:
        residuals = (getattr(point, field) for field, _ in CONTROL_FIELDS)
        known = tuple(None if isinstance(v, float) and not math.isfinite(v) else _plain(v) for v in residuals)
        values.append((Point(x, y, z if math.isfinite(z) else 0.0), known))
    return _Table("control", "POINT", CONTROL_FIELDS, tuple(values))


def _write_styles(connection: sqlite3.Connection, tables: Sequence[_Table]) -> None:
    """Store the styles of the layers where QGIS looks for them."""
    connection.executescript(STYLES_SCHEMA)
    for table in tables:
        style = STYLES / f"{table.name}.qml"
        if style.is_file():
            connection.execute(
                "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, "
                "styleName, styleQML, styleSLD, useAsDefault, description, owner) "
                "VALUES ('', '', ?, 'geom', ?, ?, '', 1, 'On-the-Fly3R', '')",
                (table.name, table.name, style.read_text(encoding="utf-8")),
            )


def _write(connection: sqlite3.Connection, table: _Table, reference: int) -> None:
    columns = ", ".join(f'"{name}" {kind}' for name, kind in table.fields)
    connection.execute(
        f'CREATE TABLE "{table.name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {table.geometry}, {columns})'
    )
    marks = ", ".join("?" * (len(table.fields) + 1))
    names = ", ".join(["geom", *(f'"{name}"' for name, _ in table.fields)])
    connection.executemany(
        f'INSERT INTO "{table.name}" ({names}) VALUES ({marks})',  # noqa: S608 - names are our own
        [(_blob(shape, reference), *values) for shape, values in table.rows],
    )
    from shapely import total_bounds

    shapes = [shape for shape, _ in table.rows if shape is not None]
    bounds = [float(value) for value in total_bounds(shapes)] if shapes else [None] * 4
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


def _blob(shape: Any, reference: int) -> bytes | None:
    """Return GeoPackage binary: its header without an envelope, then little-endian WKB (ISO)."""
    from shapely import to_wkb

    if shape is None:
        return None
    header = b"GP" + struct.pack("<BBi", 0, 1, reference)
    return header + bytes(to_wkb(shape, byte_order=1, flavor="iso"))


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", errors="replace").decode("utf-8")
    return value.item() if hasattr(value, "item") else value
