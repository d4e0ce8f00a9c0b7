from __future__ import annotations

import csv
import struct
from pathlib import Path

import numpy as np
import pyproj
import pytest
import shapefile

from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.frames import enu_from_cam_rotation, world_from_cam_rotation
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.products.rows import CameraRow, placed_row, rejected_row
from onthefly3r.products.trajectory_table import write_trajectory
from onthefly3r.products.vector import FIELDS, write_cameras
from onthefly3r.records import GpsFix, PlacedCamera, Shot

CAMERA = Camera(1600, 900, 950.0, 950.0, 800.0, 450.0)
NAME = "flug 1/Übersicht.jpg"


def shot(name: str, time_s: float | None = 1_700_000_000.25) -> Shot:
    gps = GpsFix(46.8, -92.1, 190.0, rtk=50)
    return Shot(name, Path(name), 1600, 900, "DJI FC300X é", 0.6, 0.05, "guess", time_s=time_s, gps=gps)


def rows() -> list[CameraRow]:
    rotation = enu_from_cam_rotation(30.0, -90.0, 0.0)
    placed = PlacedCamera(7, NAME, CAMERA, Rigid3(rotation, np.array([576_700.5, 5_188_100.25, 200.0])), 2)
    return [
        placed_row(placed, shot(NAME), gps=(576_698.5, 5_188_101.25, 202.0), sigma_h_m=0.5, used=True),
        rejected_row(shot("b.jpg"), 9, "too few matches: é " * 40, gps=(576_710.0, 5_188_120.0, None), retries=3),
        rejected_row(shot("c.jpg", None), 10, "no position"),
    ]


def test_shapefile_reads_back(tmp_path: Path) -> None:
    assert write_cameras(tmp_path / "cameras.shp", rows(), "EPSG:32615+5773") == 2
    assert {p.suffix for p in tmp_path.iterdir()} == {".shp", ".shx", ".dbf", ".prj", ".cpg"}
    with shapefile.Reader(str(tmp_path / "cameras.shp")) as reader:
        assert reader.shapeType == shapefile.POINTZ
        shapes, records = reader.shapes(), [record.as_dict() for record in reader.records()]
    assert shapes[0].points[0] == (576_700.5, 5_188_100.25)
    assert shapes[0].z[0] == 200.0
    first, second = records
    assert first["image"] == NAME
    assert (first["number"], second["number"]) == (8, 9)  # index 7 and the next
    assert first["cam"] == "DJI FC300X é"
    assert (first["status"], first["used"], first["batch"], first["rtk"], first["retries"]) == (
        "placed",
        True,
        2,
        50,
        0,
    )
    assert first["kappa"] == pytest.approx(-30.0)
    assert (first["yaw"], first["pitch"]) == (pytest.approx(30.0), pytest.approx(-90.0))
    assert (first["dx"], first["dy"], first["dz"]) == (2.0, -1.0, -2.0)
    assert first["d_h"] == pytest.approx(5**0.5, abs=1e-4)
    assert first["d_3d"] == 3.0
    assert (first["sig_h"], first["sig_v"]) == (0.5, None)
    assert first["t_utc"] == "2023-11-14T22:13:20.250Z"
    assert (second["status"], second["x"], second["omega"], second["retries"]) == ("rejected", None, None, 3)
    assert len(second["reason"].encode()) <= 254
    assert second["reason"].startswith("too few matches")
    assert shapes[1].points[0] == (576_710.0, 5_188_120.0)


def test_a_long_name_keeps_its_end(tmp_path: Path) -> None:
    row = rejected_row(shot("ü" * 300 + "/DJI_0001.JPG"), 1, "", gps=(0.0, 0.0, 0.0))
    write_cameras(tmp_path / "cameras.shp", [row], None)
    with shapefile.Reader(str(tmp_path / "cameras.shp")) as reader:
        name = reader.record(0)["image"]
    assert name.endswith("ü/DJI_0001.JPG")
    assert name.startswith("...")


def test_dbf_header_follows_the_format(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.shp", rows(), "EPSG:32615")
    data = (tmp_path / "cameras.dbf").read_bytes()
    (count, header_size) = struct.unpack_from("<IH", data, 4)
    assert count == 2
    names = [data[at : at + 11].split(b"\0")[0].decode("ascii") for at in range(32, header_size - 1, 32)]
    assert names == [name for name, *_ in FIELDS]
    assert all(len(name) <= 10 for name in names)
    assert (tmp_path / "cameras.cpg").read_text() == "UTF-8"


def test_prj_is_horizontal_esri_wkt(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.shp", rows(), "EPSG:32615+5773")
    wkt = (tmp_path / "cameras.prj").read_text(encoding="utf-8")
    assert wkt.startswith('PROJCS["WGS_1984_UTM_Zone_15N"')
    assert "VERT" not in wkt
    assert pyproj.CRS.from_wkt(wkt).to_epsg(min_confidence=20) == 32615


def test_local_frame_has_no_prj_and_removes_an_old_one(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.shp", rows(), "EPSG:32615")
    write_cameras(tmp_path / "cameras.shp", rows(), None)
    assert not (tmp_path / "cameras.prj").exists()


def test_a_failure_leaves_the_old_files(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.shp", rows(), "EPSG:32615")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(pyproj.exceptions.CRSError):
        write_cameras(tmp_path / "cameras.shp", rows()[:1], "EPSG:1")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_yaw_counts_from_true_north() -> None:
    placed = PlacedCamera(0, "a.jpg", CAMERA, Rigid3(enu_from_cam_rotation(179.0, -60.0, 0.0), np.zeros(3)), 0)
    row = placed_row(placed, shot("a.jpg"), convergence_deg=2.0)
    assert row.yaw == pytest.approx(-179.0)
    assert row.pitch == pytest.approx(-60.0)


def test_trajectory_reads_back(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "trajectory.csv", rows())
    with (tmp_path / "trajectory.csv").open(encoding="utf-8", newline="") as stream:
        read = list(csv.DictReader(stream))
    assert list(read[0]) == ["image", "x", "y", "z", "omega", "phi", "kappa", "status"]
    assert [r["image"] for r in read] == [NAME, "b.jpg", "c.jpg"]
    assert [r["status"] for r in read] == ["placed", "rejected", "rejected"]
    assert read[1]["x"] == ""
    angles = [float(read[0][name]) for name in ("omega", "phi", "kappa")]
    assert np.allclose(world_from_cam_rotation(*angles), enu_from_cam_rotation(30.0, -90.0, 0.0), atol=1e-7)
