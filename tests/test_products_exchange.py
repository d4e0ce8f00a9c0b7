"""Cameras for other programs: what is written is read back by independent readers, and the conventions hold."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.frames import world_from_cam_rotation
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.products.exchange import EXCHANGE_FILES, calibration, write_exchange
from onthefly3r.products.rows import CameraRow, placed_row
from onthefly3r.records import PlacedCamera, Shot

CAMERA = Camera(1600, 1200, 1210.0, 1208.0, 828.0, 622.0, (-0.015, 0.008, 0.003, 0.006))
NAMES = ("a <1>.jpg", "b & c.jpg", "ü.jpg")


def cameras() -> tuple[list[PlacedCamera], list[CameraRow]]:
    rng = np.random.default_rng(0)
    placed, rows = [], []
    for index, name in enumerate(NAMES):
        rotation = world_from_cam_rotation(*rng.uniform(-20.0, 20.0, 2), float(rng.uniform(-180.0, 180.0)))
        pose = Rigid3(rotation, np.array([500000.0, 5300000.0, 400.0]) + rng.uniform(0, 100, 3))
        placed.append(PlacedCamera(index, name, CAMERA, pose, 0))
        shot = Shot(name, Path(name), 1600, 1200, "camera", 0.75, 0.05, "guess")
        rows.append(placed_row(placed[-1], shot))
    return placed, rows


def test_angles_and_positions_go_there_and_back(tmp_path: Path) -> None:
    placed, rows = cameras()
    write_exchange(tmp_path, placed, rows, "EPSG:32633")
    assert all((tmp_path / name).is_file() for name in EXCHANGE_FILES)
    lines = [line.split("\t") for line in (tmp_path / "exchange/opk.txt").read_text(encoding="utf-8").splitlines()[2:]]
    table = list(csv.DictReader(io.StringIO((tmp_path / "exchange/pix4d.csv").read_text(encoding="utf-8"))))
    for camera, line, row in zip(placed, lines, table, strict=True):
        assert line[0] == row["imagename"] == camera.name
        for x, y, z, *angles in (
            map(float, line[1:]),
            (float(row[n]) for n in ("X", "Y", "Z", "Omega", "Phi", "Kappa")),
        ):
            assert np.allclose((x, y, z), camera.world_from_cam.translation, atol=1e-5)
            assert np.allclose(world_from_cam_rotation(*angles), camera.world_from_cam.rotation, atol=1e-7)


def test_xml_and_geojson_are_what_they_say(tmp_path: Path) -> None:
    placed, rows = cameras()
    write_exchange(tmp_path, placed, rows, "EPSG:32633")
    tree = ElementTree.fromstring((tmp_path / "exchange/metashape.xml").read_text(encoding="utf-8"))
    assert [camera.get("label") for camera in tree.iter("camera")] == list(NAMES)
    for element, camera in zip(tree.iter("camera"), placed, strict=True):
        matrix = np.array((element.findtext("transform") or "").split(), float).reshape(4, 4)
        assert np.array_equal(matrix, camera.world_from_cam.matrix())
    told = json.loads((tmp_path / "exchange/shots.geojson").read_text(encoding="utf-8"))
    lon, lat, height = told["features"][0]["geometry"]["coordinates"]
    assert 14.9 < lon < 15.1 and 47.8 < lat < 47.9 and height == rows[0].z
    write_exchange(tmp_path / "local", placed, rows, None)


def test_conventions_of_calibrations_agree_with_our_projection() -> None:
    """OpenCV by itself; Metashape by its documented formula."""
    import cv2

    told = calibration(CAMERA)
    points = np.random.default_rng(1).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.3), (50, 3))
    expected = CAMERA.project(points)
    matrix, distortion = np.array(told["opencv"]["camera_matrix"]), np.array(told["opencv"]["distortion"])
    found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    assert np.allclose(found[:, 0] + 0.5, expected)
    own = told["metashape"]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1.0 + own["k1"] * r2 + own["k2"] * r2**2
    xd = x * radial + own["p1"] * (r2 + 2 * x * x) + 2 * own["p2"] * x * y
    yd = y * radial + own["p2"] * (r2 + 2 * y * y) + 2 * own["p1"] * x * y
    u = 0.5 * 1600 + own["cx"] + xd * own["f"] + xd * own["b1"]
    assert np.allclose(np.stack([u, 0.5 * 1200 + own["cy"] + yd * own["f"]], axis=1), expected)
