"""The main algorithm: run by qgis_process and by processing.run, on rendered and on real photographs."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from maps import render, seen_at

HEAVY = {"PIL", "cv2", "gtsam", "laspy", "numpy", "pycolmap", "pyproj", "scipy", "shapefile", "torch", "typer"}
LIGHT = {"files", "atomic", "las_index"}


def test_qgis_process_runs_it(qgis_process: Any, survey: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = qgis_process(
        "run",
        "onthefly3r:reconstruct",
        "--json",
        f"--PHOTOS={survey / 'photos'}",
        "--QUALITY=preview",
        f"--OUTPUT={out}",
        f"--CAMERAS={tmp_path / 'cameras.gpkg'}",
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    results = json.loads(ran.stdout[ran.stdout.index("{") :])["results"]
    assert results["PLACED"] == results["GIVEN"] == 12
    assert results["CRS_OUT"] == "EPSG:32633"
    assert 0.0 < results["RMSE_H"] < 1.0 and 0.0 < results["RMSE_V"] < 1.0
    assert 0.15 < results["GSD"] < 0.21  # 80 m above ground, 8.8 mm behind 640 px
    assert results["POINTS"] > 50_000
    assert Path(results["CLOUD"]).is_file()
    assert "12 of 12 photographs" in Path(results["REPORT"]).read_text(encoding="utf-8")  # nothing was rejected
    assert (tmp_path / "cameras.gpkg").is_file()


def test_layers_have_crs_fields_and_the_place_of_the_survey(run: dict[str, Any], survey: Path) -> None:
    cameras, footprints, rejected = run["CAMERAS"], run["FOOTPRINTS"], run["REJECTED"]
    assert cameras.crs().authid() == footprints.crs().authid() == rejected.crs().authid() == "EPSG:32633"
    assert cameras.featureCount() == footprints.featureCount() == 12
    assert rejected.featureCount() == 0
    truth = json.loads((survey / "truth" / "origin.json").read_text(encoding="utf-8"))
    middle = cameras.extent().center()
    east, north = projected(truth["lat_deg"], truth["lon_deg"], "EPSG:32633")
    assert abs(middle.x() - east) < 60.0 and abs(middle.y() - north) < 60.0
    assert footprints.extent().contains(cameras.extent())
    first = next(cameras.getFeatures())
    assert Path(first["path"]) == survey / "photos" / first["image"] and Path(first["path"]).is_file()
    assert first["status"] == "placed" and first["used"] is True and first["rtk"] == 50
    assert abs(first["x"] - first["gps_x"] - first["dx"]) < 1e-3
    assert abs(first.geometry().constGet().z() - first["z"]) < 1e-3
    assert abs(first["pitch"] + 90.0) < 5.0
    names = [field.name() for field in cameras.fields()]
    assert {"image", "number", "omega", "dx", "path"} <= set(names) and len(set(names)) == len(names)
    for layer in (cameras, footprints):
        assert sorted(feature["number"] for feature in layer.getFeatures()) == list(range(1, 13))
    assert not next(footprints.getFeatures()).geometry().isMultipart()


def projected(lat_deg: float, lon_deg: float, crs: str) -> tuple[float, float]:
    from qgis.core import QgsCoordinateReferenceSystem, QgsCoordinateTransform, QgsPointXY, QgsProject

    systems = (QgsCoordinateReferenceSystem(name) for name in ("EPSG:4326", crs))
    point = QgsCoordinateTransform(*systems, QgsProject.instance()).transform(QgsPointXY(lon_deg, lat_deg))
    return point.x(), point.y()


def test_every_declared_output_is_given(run: dict[str, Any], qgis: Any) -> None:
    from qgis.core import QgsApplication

    algorithm = QgsApplication.processingRegistry().algorithmById("onthefly3r:reconstruct")
    assert set(run) == {output.name() for output in algorithm.outputDefinitions()}


def test_map_shows_cameras_in_their_footprints(run: dict[str, Any], plugin: Any) -> None:
    styles = plugin("processing_algorithms.presentation").STYLES
    for name, style in (("CAMERAS", "cameras.qml"), ("FOOTPRINTS", "footprints.qml")):
        _, loaded = run[name].loadNamedStyle(str(styles / style))
        assert loaded
    picture = render([run["CAMERAS"], run["FOOTPRINTS"]], run["FOOTPRINTS"].extent())
    only_cameras = render([run["CAMERAS"]], run["FOOTPRINTS"].extent())
    for feature in run["CAMERAS"].getFeatures():
        assert seen_at(only_cameras, run["FOOTPRINTS"].extent(), feature.geometry().asPoint(), 4)
    for feature in run["FOOTPRINTS"].getFeatures():
        assert seen_at(picture, run["FOOTPRINTS"].extent(), feature.geometry().centroid().asPoint(), 1)
    share = sum(only_cameras.pixel(x, y) != 0xFFFFFFFF for x in range(0, 600, 3) for y in range(0, 600, 3)) / 200**2
    assert 0.001 < share < 0.2  # dots, neither nothing nor everything


def test_process_of_qgis_stays_light(run: dict[str, Any], modules_before_plugin: set[str]) -> None:
    loaded = set(sys.modules) - modules_before_plugin
    assert not {name.split(".")[0] for name in loaded} & HEAVY
    core = {name.rpartition(".")[2] for name in loaded if ".core.onthefly3r." in name}
    assert core <= {"errors", "option_fields", "options", "protocol", "strict_json"} | LIGHT


def test_files_are_those_of_the_command_line(run: dict[str, Any]) -> None:
    out = Path(run["OUTPUT"])
    assert out.name == "Flug 1, Süd"
    for name in ("cloud.laz", "cameras.shp", "footprints.shp", "trajectory.csv", "report.json", "preview.png"):
        assert (out / name).stat().st_size > 100


def test_boundary_cuts_the_cloud(qgis: Any, run: dict[str, Any], tmp_path: Path) -> None:
    middle = run["FOOTPRINTS"].extent().center()
    half = f"{middle.x() - 1000},{middle.x()},{middle.y() - 1000},{middle.y() + 1000} [EPSG:32633]"
    parameters = {"RUN": run["OUTPUT"], "EXTENT": half, "OUTPUT": str(tmp_path / "west.laz")}
    cut = qgis.run("onthefly3r:exportcloud", parameters)
    assert 0.25 * run["POINTS"] < cut["POINTS"] < 0.75 * run["POINTS"]


@pytest.mark.photographs
def test_real_photographs(qgis: Any, photograph_sets: Path, tmp_path: Path) -> None:
    sinks = dict.fromkeys(("CAMERAS", "FOOTPRINTS", "REJECTED"), "TEMPORARY_OUTPUT")
    photos = photograph_sets / "brighton_beach" / "photos"
    ran = qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(photos), "OUTPUT": str(tmp_path / "out"), **sinks})
    assert ran["PLACED"] == 18 and ran["CRS_OUT"] == "EPSG:32615"
    east, north = projected(46.8427, -91.9946, "EPSG:32615")
    assert ran["CAMERAS"].extent().buffered(100.0).contains(east, north)
    assert ran["CAMERAS"].extent().width() < 200.0
    picture = render([ran["CAMERAS"], ran["FOOTPRINTS"]], ran["FOOTPRINTS"].extent())
    for feature in ran["CAMERAS"].getFeatures():
        assert seen_at(picture, ran["FOOTPRINTS"].extent(), feature.geometry().asPoint(), 4)
