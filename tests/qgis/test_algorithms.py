"""The algorithms beside the main one, each on real files."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest


def test_export_cloud(qgis: Any, run: dict[str, Any], tmp_path: Path) -> None:
    parameters = {"RUN": run["OUTPUT"], "OUTPUT": str(tmp_path / "wölke.las"), "SPACING_M": 1.0, "CRS": "EPSG:25833"}
    (tmp_path / "wölke.copc.laz").write_text("of somebody else")
    exported = qgis.run("onthefly3r:exportcloud", parameters)
    assert exported["CRS_OUT"] == "EPSG:25833"
    assert 1000 < exported["POINTS"] < 0.5 * run["POINTS"]
    assert 0.5 < exported["SPACING"] < 2.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wölke.copc.laz", "wölke.las"]
    assert (tmp_path / "wölke.las").read_bytes()[:4] == b"LASF"


def test_export_cloud_refuses_other_endings(qgis: Any, run: dict[str, Any], tmp_path: Path) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match=r"neither in \.laz, \.copc\.laz nor in \.las"):
        qgis.run("onthefly3r:exportcloud", {"RUN": run["OUTPUT"], "OUTPUT": str(tmp_path / "cloud.xyz")})


def test_export_cameras_as_they_are(qgis: Any, run: dict[str, Any], tmp_path: Path) -> None:
    parameters = {"RUN": run["OUTPUT"], "CAMERAS": str(tmp_path / "cameras.gpkg"), "FOOTPRINTS": "TEMPORARY_OUTPUT"}
    exported = qgis.run("onthefly3r:exportcameras", parameters)
    assert (exported["PLACED"], exported["GIVEN"]) == (12, 12)
    assert places(tmp_path / "cameras.gpkg") == pytest.approx(places(run["CAMERAS"]), abs=1e-3)
    assert "REJECTED" not in exported


def test_export_cameras_in_another_crs_turns_the_angles(qgis: Any, run: dict[str, Any], tmp_path: Path) -> None:
    from qgis.core import QgsCoordinateReferenceSystem, QgsCoordinateTransform, QgsProject, QgsVectorLayer

    parameters = {"RUN": run["OUTPUT"], "CRS": "EPSG:3035", "CAMERAS": str(tmp_path / "cameras.shp")}
    qgis.run("onthefly3r:exportcameras", parameters)
    layer = QgsVectorLayer(str(tmp_path / "cameras.shp"))
    crs = QgsCoordinateReferenceSystem("EPSG:3035")
    assert layer.crs() == crs
    move = QgsCoordinateTransform(run["CAMERAS"].crs(), crs, QgsProject.instance())
    ours = {feature["image"]: feature for feature in layer.getFeatures()}
    for before in run["CAMERAS"].getFeatures():
        after = ours[before["image"]]
        point = before.geometry().asPoint()
        assert move.transform(point).distance(after.geometry().asPoint()) < 0.01
        assert after["yaw"] == pytest.approx(before["yaw"], abs=0.01)
        turned = (after["kappa"] - before["kappa"] + 180.0) % 360.0 - 180.0
        assert 2.0 < abs(turned) < 6.0  # the grids' norths differ: 15.6 and 10 degrees of longitude, 48 of latitude


def places(layer: Any) -> list[float]:
    """All coordinates of a layer of points, by image."""
    from qgis.core import QgsVectorLayer

    layer = QgsVectorLayer(str(layer)) if isinstance(layer, Path) else layer
    features = sorted(layer.getFeatures(), key=lambda feature: feature["image"])
    points = [feature.geometry().asPoint() for feature in features]
    return [value for point in points for value in (point.x(), point.y())]


def test_georeference_with_positions_from_a_file(qgis: Any, run: dict[str, Any], tmp_path: Path) -> None:
    lines = ["EPSG:32633"]
    for feature in run["CAMERAS"].getFeatures():
        east, north, height = (feature[name] for name in ("gps_x", "gps_y", "gps_z"))
        lines.append(f"{feature['image']} {east + 100.0} {north - 50.0} {height + 7.0}")
    (tmp_path / "geo.txt").write_text("\n".join(lines), encoding="utf-8")
    parameters = {
        "RUN": run["OUTPUT"],
        "POSITIONS": str(tmp_path / "geo.txt"),
        "VERTICAL": "egm96",
        "OUTPUT": str(tmp_path / "again"),
        "CAMERAS": "TEMPORARY_OUTPUT",
    }
    again = qgis.run("onthefly3r:georeference", parameters)
    assert again["CRS_OUT"] == "EPSG:32633" and again["PLACED"] == 12
    report = json.loads((tmp_path / "again" / "report.json").read_text(encoding="utf-8"))
    assert report["georeference"]["vertical"] == "egm96"
    moved = [b - a for a, b in zip(places(run["CAMERAS"]), places(again["CAMERAS"]), strict=True)]
    assert moved[0::2] == pytest.approx([100.0] * 12, abs=0.3)
    assert moved[1::2] == pytest.approx([-50.0] * 12, abs=0.3)


def test_georeference_does_not_overwrite_the_run(qgis: Any, run: dict[str, Any]) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match="output folder is that of the run"):
        qgis.run("onthefly3r:georeference", {"RUN": run["OUTPUT"], "OUTPUT": run["OUTPUT"]})


def test_many_flights(qgis: Any, survey: Path, feedback: Any, tmp_path: Path) -> None:
    shutil.copytree(survey / "photos", tmp_path / "day" / "good")
    (tmp_path / "day" / "two").mkdir()
    for name in ("SIM_0001.JPG", "SIM_0002.JPG"):
        shutil.copy(survey / "photos" / name, tmp_path / "day" / "two")
    table = tmp_path / "flights.csv"
    table.write_text("name;photos;working_px\nfails;day/two;\nflies;day/good;500\n", encoding="utf-8")
    parameters = {
        "TABLE": str(table),
        "QUALITY": "preview",
        "OUTPUT": str(tmp_path / "out"),
        "FLIGHTS": "TEMPORARY_OUTPUT",
    }
    ran = qgis.run("onthefly3r:reconstructflights", parameters, feedback=feedback)
    assert (ran["DONE"], ran["FAILED"]) == (1, 1)
    rows = {feature["flight"]: feature for feature in ran["FLIGHTS"].getFeatures()}
    assert rows["fails"]["status"] == "failed" and "overlap too little" in rows["fails"]["message"]
    assert rows["flies"]["status"] == "done" and rows["flies"]["placed"] == 12
    assert any("fails: failed" in text for text in feedback.told)
    assert sum("1 of 2 flights failed" in text for text in feedback.told) == 1
    report = json.loads((tmp_path / "out" / "flies" / "report.json").read_text(encoding="utf-8"))
    assert report["software"]["options"]["working_px"] == 500
    with Path(ran["FLIGHTS_CSV"]).open(encoding="utf-8") as stream:
        assert [row["flight"] for row in csv.DictReader(stream)] == ["fails", "flies"]
    made = (tmp_path / "out" / "flies" / "report.json").stat().st_mtime_ns
    ran = qgis.run("onthefly3r:reconstructflights", {**parameters, "SKIP_DONE": True})
    assert (ran["DONE"], ran["FAILED"]) == (1, 1)
    assert (tmp_path / "out" / "flies" / "report.json").stat().st_mtime_ns == made


def test_many_flights_want_one_source(qgis: Any, tmp_path: Path) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match="either a parent folder"):
        qgis.run("onthefly3r:reconstructflights", {"OUTPUT": str(tmp_path / "out")})
    with pytest.raises(QgsProcessingException, match="none of its sub-folders holds photographs"):
        qgis.run("onthefly3r:reconstructflights", {"FOLDER": str(tmp_path), "OUTPUT": str(tmp_path / "out")})


def test_check(qgis: Any, survey: Path, tmp_path: Path) -> None:
    from qgis.PyQt.QtGui import QImage

    photos = tmp_path / "photos"
    shutil.copytree(survey / "photos", photos)
    assert QImage(str(photos / "SIM_0003.JPG")).save(str(photos / "SIM_0003.JPG"))  # without tags
    (photos / "broken.jpg").write_bytes(b"no photograph")
    parameters = {"PHOTOS": str(photos), "CHECKED": "TEMPORARY_OUTPUT", "FOOTPRINTS": "TEMPORARY_OUTPUT"}
    checked = qgis.run("onthefly3r:check", parameters)
    assert (checked["GIVEN"], checked["GOOD"], checked["DOUBTFUL"], checked["UNUSABLE"]) == (13, 11, 1, 1)
    rows = {feature["image"]: feature for feature in checked["CHECKED"].getFeatures()}
    assert rows["SIM_0003.JPG"]["verdict"] == "doubtful" and "no position" in rows["SIM_0003.JPG"]["problems"]
    assert not rows["SIM_0003.JPG"].hasGeometry()
    assert rows["broken.jpg"]["verdict"] == "unusable"
    assert rows["SIM_0001.JPG"]["above_ground_m"] == pytest.approx(80.0, abs=5.0)
    assert checked["CHECKED"].crs().authid() == checked["FOOTPRINTS"].crs().authid() == "EPSG:32633"
    assert checked["FOOTPRINTS"].featureCount() == 11
    assert [field.name() for field in checked["FOOTPRINTS"].fields()] == ["image", "gsd_m", "area_m2", "overlap"]
    assert checked["FOOTPRINTS"].extent().contains(checked["CHECKED"].extent())
    assert 0.6 < checked["OVERLAP"] < 0.95 and 0.15 < checked["GSD"] < 0.21
    assert checked["TIME"] > 0.0 and checked["MEMORY"] > 100.0
    assert "1 of 12 photographs have no position" in checked["WARNINGS"]


def test_check_in_a_model_feeds_another_algorithm(qgis: Any, survey: Path) -> None:
    from qgis.core import (
        QgsProcessingModelAlgorithm,
        QgsProcessingModelChildAlgorithm,
        QgsProcessingModelChildParameterSource,
        QgsProcessingModelOutput,
        QgsProcessingModelParameter,
        QgsProcessingParameterFile,
    )

    model = QgsProcessingModelAlgorithm("check", "tests")
    folder = QgsProcessingParameterFile("PHOTOS", "Photographs", QgsProcessingParameterFile.Behavior.Folder)
    model.addModelParameter(folder, QgsProcessingModelParameter("PHOTOS"))
    check = QgsProcessingModelChildAlgorithm("onthefly3r:check")
    check.setChildId("check")
    check.addParameterSources("PHOTOS", [QgsProcessingModelChildParameterSource.fromModelParameter("PHOTOS")])
    model.addChildAlgorithm(check)
    buffer = QgsProcessingModelChildAlgorithm("native:buffer")
    buffer.setChildId("buffer")
    source = QgsProcessingModelChildParameterSource.fromChildOutput("check", "CHECKED")
    buffer.addParameterSources("INPUT", [source])
    buffer.addParameterSources("DISTANCE", [QgsProcessingModelChildParameterSource.fromStaticValue(10.0)])
    output = QgsProcessingModelOutput("AREAS", "Areas")
    output.setChildOutputName("OUTPUT")
    output.setChildId("buffer")
    buffer.setModelOutputs({"AREAS": output})
    model.addChildAlgorithm(buffer)
    model.updateDestinationParameters()
    name = next(item.name() for item in model.destinationParameterDefinitions())
    ran = qgis.run(model, {"PHOTOS": str(survey / "photos"), name: "TEMPORARY_OUTPUT"})
    assert ran[name].featureCount() == 12
    assert ran[name].crs().authid() == "EPSG:32633"


def test_evaluate(qgis: Any, run: dict[str, Any], survey: Path, tmp_path: Path) -> None:
    parameters = {
        "RUN": run["OUTPUT"],
        "REFERENCE_POSES": str(survey / "truth" / "images.txt"),
        "REFERENCE_CLOUD": run["CLOUD"],
        "TABLE": str(tmp_path / "table.csv"),
    }
    told = qgis.run("onthefly3r:evaluate", parameters)
    assert told["COVERAGE"] == 1.0 and told["COMMON"] == 12
    assert 0.0 < told["ATE"] < 1.0 and 0.0 < told["ARE"] < 1.0
    assert told["CHAMFER"] == told["ACCURACY"] == told["COMPLETENESS"] == 0.0  # with itself
    with (tmp_path / "table.csv").open(encoding="utf-8") as stream:
        rows = {row["metric"]: row for row in csv.DictReader(stream)}
    assert float(rows["ATE"]["value"]) == pytest.approx(told["ATE"])
    assert {"ARE", "RTE", "RRE", "Acc.", "Comp.", "CD"} <= set(rows)


def test_evaluate_wants_a_reference(qgis: Any, run: dict[str, Any]) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match="Give reference cameras"):
        qgis.run("onthefly3r:evaluate", {"RUN": run["OUTPUT"]})
