"""The layers of a run: which, from where, in which order, what they show; on a run's folder made by hand."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from survey_folder import BRICK, SIDE_M, SOUTH, WEST, make_ept, make_run

ORDER = [
    "Rejected photographs", "Cameras", "Ground control", "Footprints", "Orthophoto", "Surface model (DSM)",
    "Terrain model (DTM)",
]  # fmt: skip


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return tmp_path / "2026-05 Steinbruch #1 ü" / "DCIM" / "100MEDIA"


@pytest.fixture(params=[True, False], ids=["geopackage", "shapefiles"])
def folder(request: Any, qgis: Any, tmp_path: Path, photos: Path) -> Path:
    return make_run(tmp_path / "out", photos, request.param)


@pytest.fixture
def loaded(qgis: Any, folder: Path, project: Any, feedback: Any) -> Any:
    qgis.runAndLoadResults("onthefly3r:loadresults", {"RUN": str(folder)}, feedback=feedback)
    return project


def nodes(project: Any) -> list[Any]:
    (group,) = project.layerTreeRoot().children()
    return list(group.children())


def test_layers_come_from_the_files_in_their_order(loaded: Any, folder: Path) -> None:
    (group,) = loaded.layerTreeRoot().children()
    assert group.name() == "2026-05 Steinbruch #1 ü"
    names = [node.name() for node in nodes(loaded)]
    if not (folder / "survey.gpkg").is_file():
        assert names == [name for name in ORDER if name != "Ground control"]
    else:
        assert names == ORDER
    for layer in loaded.mapLayers().values():
        assert layer.isValid() and str(folder) in layer.source() and layer.crs().authid() == "EPSG:32633"
    counts = {node.name(): node.layer().featureCount() for node in nodes(loaded)[:2]}
    assert counts == {"Rejected photographs": 1, "Cameras": 2}
    off = {node.name() for node in nodes(loaded) if not node.itemVisibilityChecked()}
    assert off == {"Footprints", "Terrain model (DTM)"}


def test_it_says_once_what_the_report_warns_of(loaded: Any, feedback: Any) -> None:
    assert feedback.told.count("a first warning") == feedback.told.count("a second one") == 1
    assert any("Only 2 of 3 photographs were placed" in text for text in feedback.told)
    assert sum("no reader for point clouds" in text for text in feedback.told) <= 1


def test_a_click_on_a_camera_shows_its_photograph(loaded: Any, photos: Path) -> None:
    from qgis.core import QgsExpression, QgsExpressionContext, QgsExpressionContextUtils
    from qgis.PyQt.QtCore import QUrl
    from qgis.PyQt.QtGui import QImage

    cameras = next(node.layer() for node in nodes(loaded) if node.name() == "Cameras")
    widget = cameras.editorWidgetSetup(cameras.fields().indexOf("path"))
    assert widget.type() == "ExternalResource" and widget.config()["DocumentViewer"] == 1
    for feature in cameras.getFeatures():
        assert Path(feature["path"]) == photos / feature["image"]
        context = QgsExpressionContext(QgsExpressionContextUtils.globalProjectLayerScopes(cameras))
        context.setFeature(feature)
        tip = QgsExpression.replaceExpressionText(cameras.mapTipTemplate(), context)
        address = tip.partition('src="')[2].partition('"')[0]
        assert not QImage(QUrl(address).toLocalFile()).isNull()


def test_map_tip_tells_why_a_photograph_was_rejected(loaded: Any, folder: Path) -> None:
    from qgis.core import QgsExpression, QgsExpressionContext, QgsExpressionContextUtils

    rejected = nodes(loaded)[0].layer()
    context = QgsExpressionContext(QgsExpressionContextUtils.globalProjectLayerScopes(rejected))
    context.setFeature(next(rejected.getFeatures()))
    tip = QgsExpression.replaceExpressionText(rejected.mapTipTemplate(), context)
    assert "c.jpg" in tip and "blurred" in tip and "[%" not in tip
    assert ("queries" in tip) == ("stage" in [field.name() for field in rejected.fields()])


def test_layers_are_styled_and_painted(loaded: Any) -> None:
    from maps import render
    from qgis.core import QgsRectangle
    from qgis.PyQt.QtGui import QColor

    layers = {node.name(): node.layer() for node in nodes(loaded)}
    assert layers["Cameras"].renderer().type() == "RuleRenderer"
    assert layers["Surface model (DSM)"].renderer().type() == "singlebandpseudocolor"
    extent = QgsRectangle(WEST, SOUTH, WEST + SIDE_M, SOUTH + SIDE_M)
    picture = render([layers["Orthophoto"]], extent)
    assert QColor(picture.pixel(300, 300)).getRgb()[:3] == BRICK
    picture = render([layers["Surface model (DSM)"]], extent)
    assert len({picture.pixel(300, y) for y in range(0, 600, 10)}) > 20


def test_cloud_goes_to_the_provider_that_shows_it(plugin: Any, folder: Path) -> None:
    survey = plugin("processing_algorithms.survey")

    def cloud(*providers: str) -> list[str]:
        return [
            Path(layer.uri).name for layer in survey.survey_layers(folder, ("ogr", *providers)) if layer.name == "cloud"
        ]

    assert cloud() == cloud("copc") == [] and survey.has_unreadable_cloud(folder, ("ogr",))
    assert cloud("pdal") == ["cloud.laz"] and not survey.has_unreadable_cloud(folder, ("pdal",))
    (folder / "cloud.copc.laz").write_bytes(b"LASF")
    assert cloud("copc") == cloud("pdal", "copc") == ["cloud.copc.laz"]
    order = [layer.name for layer in survey.survey_layers(folder, ("ogr", "copc"))]
    assert order.index("orthophoto") < order.index("cloud") < order.index("dsm")


@pytest.mark.parametrize("colour", [BRICK, (12, 200, 90)])
def test_cloud_is_painted_in_its_colours(qgis: Any, plugin: Any, tmp_path: Path, colour: tuple[int, int, int]) -> None:
    """A cloud that the oldest QGIS reads too: the renderer is the same for COPC."""
    from maps import render
    from qgis.core import QgsPointCloudLayer, QgsProcessingContext, QgsProcessingFeedback, QgsProviderRegistry
    from qgis.PyQt.QtGui import QColor

    if "ept" not in QgsProviderRegistry.instance().providerList():
        pytest.skip("this QGIS has no provider for EPT")
    layer = QgsPointCloudLayer(str(make_ept(tmp_path / "ept", colour)), "cloud", "ept")
    assert layer.isValid() and layer.pointCount() == 1600
    processor = plugin("processing_algorithms.presentation").Presentation("", "cloud", 30)
    processor.postProcessLayer(layer, QgsProcessingContext(), QgsProcessingFeedback())
    picture = render([layer], layer.extent())
    seen = {picture.pixel(x, y) for x in range(600) for y in range(600)} - {0xFFFFFFFF}
    found = [QColor(value).getRgb()[:3] for value in seen]
    near = [all(abs(a - b) <= 3 for a, b in zip(rgb, colour, strict=True)) for rgb in found]
    assert any(near), found[:10]
    drawn = sum(picture.pixel(x, y) != 0xFFFFFFFF for x in range(0, 600, 3) for y in range(0, 600, 3))
    assert drawn > 1000


def test_photographs_that_are_gone_are_not_promised(qgis: Any, plugin: Any, folder: Path, photos: Path) -> None:
    survey = plugin("processing_algorithms.survey")
    assert survey.photographs_folder(folder) == photos
    shutil.rmtree(photos)
    assert survey.photographs_folder(folder) is None
    assert survey.survey_title(folder, None) == "out"
    assert survey.photographs_folder(folder / "nothing") is None


def test_sample_flight_hands_over_its_results(
    qgis: Any, plugin: Any, tmp_path: Path, project: Any, feedback: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All but the computation: what `onthefly3r demo` leaves is made by hand."""
    out, jobs = tmp_path / "sample", []

    def run_job(python: str, job: Any, listener: Any, variables: Any) -> dict[str, Any]:
        jobs.append(job)
        make_run(out / "result", out / "photos", geopackage=False)
        return {"accuracy": {"ate_m": 0.05, "cloud_fitted_m": 0.04}}

    monkeypatch.setattr(plugin("processing_algorithms.base"), "run_job", run_job)
    told = qgis.runAndLoadResults("onthefly3r:sampleflight", {"OUTPUT": str(out)}, feedback=feedback)
    assert (jobs[0].verb, jobs[0].arguments) == ("demo", (str(out),))
    assert (told["CAMERA_ERROR"], told["CLOUD_ERROR"], told["PLACED"]) == (0.05, 0.04, 2)
    assert told["ORTHOPHOTO"] == str(out / "result" / "orthophoto.tif") and told["GEOPACKAGE"] is None
    assert [node.name() for node in nodes(project)][:2] == ["Rejected photographs", "Cameras"]
    assert plugin("plugin.settings").recent_runs()[0] == str(out / "result")


def test_results_are_not_loaded_where_that_is_not_wanted(
    qgis: Any, plugin: Any, tmp_path: Path, photos: Path, project: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The output folder that nobody named lies beside the photographs, and says so."""
    made: list[Path] = []

    def run_job(python: str, job: Any, listener: Any, variables: Any) -> dict[str, Any]:
        made.append(make_run(Path(job.arguments[1]), photos, geopackage=True))
        return {}

    survey = photos.parents[1]
    (survey / "photos").mkdir(parents=True)
    monkeypatch.setattr(plugin("processing_algorithms.base"), "run_job", run_job)
    told = qgis.runAndLoadResults(
        "onthefly3r:reconstruct", {"PHOTOS": str(survey / "photos"), "LOAD_RESULTS": False, "QUALITY": 0}
    )
    assert Path(told["OUTPUT"]) == made[0] == survey / f"{survey.name} reconstructed"
    assert not project.mapLayers() and "CAMERAS" not in told


@pytest.mark.parametrize("beside", ["top of the group", "end of the group", "top of the project"])
def test_order_holds_wherever_the_desktop_puts_new_layers(qgis: Any, plugin: Any, project: Any, beside: str) -> None:
    from qgis.core import QgsProcessingContext, QgsProcessingFeedback, QgsVectorLayer

    presentation, heights = plugin("processing_algorithms.presentation"), plugin("processing_algorithms.survey").HEIGHTS
    root, context = project.layerTreeRoot(), QgsProcessingContext()
    context.setProject(project)
    for name in ("cameras", "dsm", "footprints", "rejected", "dtm", "orthophoto", "control", "cloud"):
        layer = QgsVectorLayer("Point?crs=EPSG:32633", name, "memory")
        project.addMapLayer(layer, False)
        group = root.findGroup("quarry") if beside.endswith("group") else None
        (group or root).insertLayer(-1 if beside.startswith("end") else 0, layer)
        processor = presentation.Presentation("quarry", "", heights[name], name != "dtm")
        processor.postProcessLayer(layer, context, QgsProcessingFeedback())
    found = [node.name() for node in nodes(project)]
    assert found == ["rejected", "cameras", "control", "footprints", "orthophoto", "cloud", "dsm", "dtm"]
    assert [node.name() for node in nodes(project) if not node.itemVisibilityChecked()] == ["dtm"]
