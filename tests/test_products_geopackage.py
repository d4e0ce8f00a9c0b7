"""The GeoPackage, read with sqlite3 and shapely."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import shapely

from onthefly3r.products.footprints import Footprint
from onthefly3r.products.geopackage import write_geopackage
from onthefly3r.products.rows import CameraRow
from onthefly3r.records import ControlResidual

ROWS = [
    CameraRow("ä 1.jpg", 1, "placed", x=400_000.5, y=5_500_000.25, z=312.5, gps_x=400_001.0, gps_y=5.5e6, gps_z=312.0),
    CameraRow("bad\udcff.jpg", 2, "rejected", reason="no 'similar' photograph", gps_x=1.0, gps_y=2.0),
    CameraRow("lost.jpg", 3, "rejected", reason="damaged"),
]
OUTLINE = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 10.0], [20.0, 0.0]]) + np.array([400_000.0, 5_500_000.0])


def test_layers_geometry_and_values_come_back(tmp_path: Path) -> None:
    path = tmp_path / "süd" / "survey.gpkg"
    counts = write_geopackage(path, ROWS, [Footprint("ä 1.jpg", 1, OUTLINE, 0.05, 3)], "EPSG:32633")
    assert counts == {"cameras": 1, "rejected": 2, "footprints": 1, "coverage": 1, "fly_again": 1}
    connection = sqlite3.connect(path)
    try:
        assert connection.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
        contents = connection.execute("SELECT table_name, srs_id FROM gpkg_geometry_columns ORDER BY 1").fetchall()
        assert contents == [(name, 32633) for name in ("cameras", "coverage", "fly_again", "footprints", "rejected")]
        blob, image, z = connection.execute("SELECT geom, image, z FROM cameras").fetchone()
        point = shapely.from_wkb(blob[8:])
        assert (point.x, point.y, point.z) == (400_000.5, 5_500_000.25, 312.5)
        assert (image, z) == ("ä 1.jpg", 312.5)
        rejected = connection.execute("SELECT geom IS NULL, reason FROM rejected ORDER BY number").fetchall()
        assert rejected == [(0, "no 'similar' photograph"), (1, "damaged")]
        (polygon,) = connection.execute("SELECT geom FROM footprints").fetchone()
        assert shapely.from_wkb(polygon[8:]).area == 200.0
    finally:
        connection.close()
    assert [item.name for item in path.parent.iterdir()] == ["survey.gpkg"]


def test_local_coordinates_have_no_reference_system(tmp_path: Path) -> None:
    path = tmp_path / "survey.gpkg"
    write_geopackage(path, ROWS, [], None)
    connection = sqlite3.connect(path)
    try:
        assert connection.execute("SELECT DISTINCT srs_id FROM gpkg_geometry_columns").fetchall() == [(-1,)]
        assert connection.execute(
            "SELECT organization, definition FROM gpkg_spatial_ref_sys WHERE srs_id=-1"
        ).fetchone() == (
            "NONE",
            "undefined",
        )
    finally:
        connection.close()


def test_layers_open_styled_and_name_their_photographs(tmp_path: Path) -> None:
    path = tmp_path / "survey.gpkg"
    photograph = tmp_path / "Flüge im Mai" / "ä 1.jpg"
    row = replace(ROWS[0], sd_h=0.02, sd_v=0.04, sd_deg=0.01, part=2)
    write_geopackage(path, [row], [], "EPSG:32633", photographs={1: photograph})
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT sd_h, sd_v, sd_deg, part, path, dx FROM cameras").fetchone() == (
            0.02,
            0.04,
            0.01,
            2.0,
            str(photograph),
            -0.5,
        )
        styles = connection.execute("SELECT f_table_name, styleQML, useAsDefault FROM layer_styles ORDER BY 1")
        names = []
        for name, qml, is_default in styles.fetchall():
            assert ElementTree.fromstring(qml).tag == "qgis"
            assert is_default == 1
            names.append(name)
        assert names == ["cameras", "footprints", "rejected"]


def test_control_keeps_its_residuals(tmp_path: Path) -> None:
    path = tmp_path / "survey.gpkg"
    nan = float("nan")
    flat = ControlResidual("P ü", "checkpoint", 4, 0.01, -0.02, nan, 0.005, 0.01, 0.4, (0.0, 0.0, nan))
    place = (400_000.0, 5_500_000.0, nan)
    assert write_geopackage(path, ROWS, [], "EPSG:32633", control=[(flat, place)])["control"] == 1
    with closing(sqlite3.connect(path)) as connection:
        blob, *values = connection.execute("SELECT geom, label, role, east_m, north_m, up_m FROM control").fetchone()
        assert values == ["P ü", "checkpoint", 0.01, -0.02, None]
        assert shapely.get_coordinates(shapely.from_wkb(blob[8:]), include_z=True).tolist() == [[*place[:2], 0.0]]
