"""Clouds in different coordinate systems are transformed or refused, never compared in silence."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate.clouds import open_cloud
from onthefly3r.evaluate.comparison import evaluate, format_table
from onthefly3r.evaluate.same_frame import in_frame_of
from onthefly3r.geometry.geodesy import wkt1
from onthefly3r.geometry.geoid import egm96_undulation_m

UTM33 = np.random.default_rng(0).uniform(0, 100, (400, 3)) + np.array(
    [544_000.0, 5_339_000.0, 250.0]
)  # lat 48.2, lon 15.6


def write(path: Path, points: np.ndarray, wkt: str | None) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    step = 1e-9 if np.ptp(points[:, 0]) < 1.0 else 1e-4  # degrees or metres
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.array([step, step, 1e-4])
    if wkt is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(path)
    return path


def to(crs: str, points: np.ndarray) -> np.ndarray:
    through = pyproj.Transformer.from_crs("EPSG:32633", crs, always_xy=True)
    return np.stack([*through.transform(points[:, 0], points[:, 1]), points[:, 2]], axis=-1)


def apart_m(tmp_path: Path, reference: np.ndarray, wkt: str | None, own: str = "egm96") -> tuple[float, list[str]]:
    result = write(tmp_path / "result.laz", UTM33, wkt1("EPSG:32633", own))
    other = write(tmp_path / "reference.las", reference, wkt)
    report = evaluate(result, reference_cloud=other)
    assert report.surface is not None
    return report.surface.chamfer, list(report.notes)


def test_the_same_frame_needs_no_word(tmp_path: Path) -> None:
    error_m, notes = apart_m(tmp_path, UTM33, wkt1("EPSG:32633", "egm96"))
    assert error_m < 0.001
    assert notes == []


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:31287", "EPSG:4326"])
def test_another_projection_is_transformed(tmp_path: Path, crs: str) -> None:
    horizontal = pyproj.CRS(crs)
    vertical = pyproj.CRS("EPSG:5773")
    wkt = pyproj.crs.CompoundCRS("both", [horizontal, vertical]).to_wkt()
    error_m, notes = apart_m(tmp_path, to(crs, UTM33), wkt)
    assert error_m < (1.0 if crs == "EPSG:31287" else 0.02)  # PROJ's datum shift is good to a metre there
    assert "was transformed" in notes[0]


def test_ellipsoidal_heights_are_brought_to_the_geoid(tmp_path: Path) -> None:
    up = float(egm96_undulation_m(np.array([48.2]), np.array([15.6]))[0])
    assert up > 40.0
    error_m, notes = apart_m(tmp_path, UTM33 + np.array([0, 0, up]), wkt1("EPSG:32633", "ellipsoidal"))
    assert error_m < 0.05
    assert "was transformed" in notes[0]


def test_heights_of_unknown_reference_are_told(tmp_path: Path) -> None:
    error_m, notes = apart_m(tmp_path, UTM33, pyproj.CRS("EPSG:32633").to_wkt("WKT1_GDAL"))
    assert error_m < 0.001
    assert "heights are compared as they are" in notes[0]


def test_a_cloud_without_crs_that_lies_elsewhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ReferenceFormatError, match="apart and cannot be compared"):
        apart_m(tmp_path, UTM33 - UTM33.min(axis=0), None)
    _, notes = apart_m(tmp_path, UTM33, None)
    assert "states no CRS" in notes[0]


def test_heights_that_no_grid_at_hand_can_transform_are_refused(tmp_path: Path) -> None:
    wkt = pyproj.CRS("EPSG:32633+5783").to_wkt()  # DHHN92
    with pytest.raises(ReferenceFormatError, match="cannot transform"):
        apart_m(tmp_path, UTM33, wkt)


def test_coordinates_rounded_to_single_precision_are_told(tmp_path: Path) -> None:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(UTM33)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + UTM33.astype("<f4").tobytes())
    result = write(tmp_path / "result.laz", UTM33, None)
    _, notes = in_frame_of(open_cloud(result), open_cloud(tmp_path / "a.ply"))
    assert "rounded to 0.6" in notes[0]


def test_notes_are_part_of_the_table_and_of_the_json(tmp_path: Path) -> None:
    result = write(tmp_path / "result.laz", UTM33, wkt1("EPSG:32633", "egm96"))
    report = evaluate(result, reference_cloud=write(tmp_path / "b.las", UTM33, None))
    assert report.to_dict()["notes"] == list(report.notes)
    assert "states no CRS" in format_table(report)
