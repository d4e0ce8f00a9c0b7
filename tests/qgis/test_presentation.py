"""Layers as QGIS loads them: styled, grouped, in order; and the menu."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import pytest
from maps import render, seen_at


@pytest.fixture
def loaded(qgis: Any, run: dict[str, Any], project: Any) -> Any:
    """The project after layers were loaded as from the toolbox."""
    from qgis.core import QgsProcessingOutputLayerDefinition

    sinks = {
        name: QgsProcessingOutputLayerDefinition("TEMPORARY_OUTPUT", project)
        for name in ("CAMERAS", "REJECTED", "FOOTPRINTS")
    }
    qgis.runAndLoadResults("onthefly3r:exportcameras", {"RUN": run["OUTPUT"], **sinks})
    gc.collect()
    return project


def test_layers_are_grouped_under_the_name_of_the_survey(loaded: Any, run: dict[str, Any], survey: Path) -> None:
    root = loaded.layerTreeRoot()
    (group,) = root.children()
    assert group.name() == survey.name and survey.name != Path(run["OUTPUT"]).name
    names = [node.name() for node in group.children()]
    assert sorted(names) == ["Cameras", "Footprints", "Rejected photographs"]
    assert names[-1] == "Footprints"  # below the points
    assert [child for child in root.children() if child is not group] == [] or len(root.children()) == 1
    assert len(loaded.mapLayers()) == 3


def test_layers_are_styled(loaded: Any) -> None:
    renderers = {layer.name(): layer.renderer() for layer in loaded.mapLayers().values()}
    assert renderers["Cameras"].type() == "RuleRenderer"
    assert renderers["Footprints"].type() in ("graduatedSymbol", "categorizedSymbol")
    assert "overlap" in renderers["Footprints"].legendClassificationAttribute()
    assert all(layer.mapTipTemplate() for layer in loaded.mapLayers().values())


def test_map_of_the_project_shows_both(loaded: Any) -> None:
    layers = [node.layer() for node in loaded.layerTreeRoot().findLayers()]
    by_name = {layer.name(): layer for layer in layers}
    extent = by_name["Footprints"].extent()
    picture = render(layers, extent)
    for feature in by_name["Cameras"].getFeatures():
        assert seen_at(picture, extent, feature.geometry().asPoint(), 3)
    below = render([by_name["Footprints"]], extent)
    assert any(picture.pixel(x, y) != below.pixel(x, y) for x in range(600) for y in range(600))


@pytest.mark.parametrize("style", ["cameras", "footprints", "rejected", "checked"])
def test_styles_use_fields_that_the_layers_have(plugin: Any, style: str) -> None:
    import re

    layers = plugin("processing_algorithms.layers")
    fields = {
        "cameras": layers.CAMERA_FIELDS,
        "rejected": layers.REJECTED_FIELDS,
        "footprints": layers.FOOTPRINT_FIELDS,
        "checked": plugin("processing_algorithms.check_photographs").CHECKED_FIELDS,
    }[style]
    names = {name for name, _ in fields}
    text = (plugin("processing_algorithms.presentation").STYLES / f"{style}.qml").read_text(encoding="utf-8")
    used = set(re.findall(r"&quot;(\w+)&quot;", text)) | set(re.findall(r'attr="(\w+)"', text))
    used |= set(re.findall(r'"(\w+)" %\]', text))
    assert used and used <= names


def test_newer_qgis_groups_and_orders_itself(plugin: Any) -> None:
    class Details:
        def __init__(self) -> None:
            self.groupName, self.layerSortKey, self.kept = "", 0, None

        def setPostProcessor(self, processor: Any) -> None:
            self.kept = processor

    class Context:
        def __init__(self) -> None:
            self.details = {name: Details() for name in ("cameras", "footprints")}

        def willLoadLayerOnCompletion(self, name: str) -> bool:
            return name in self.details

        def layerToLoadOnCompletionDetails(self, name: str) -> Details:
            return self.details[name]

    context, heights = Context(), plugin("processing_algorithms.survey").HEIGHTS
    for name in ("cameras", "footprints", "not loaded"):
        plugin("processing_algorithms.presentation").show(context, name, "run", f"{name}.qml", heights.get(name, 0))
    assert {details.groupName for details in context.details.values()} == {"run"}
    assert context.details["cameras"].layerSortKey > context.details["footprints"].layerSortKey
    assert all(details.kept is not None for details in context.details.values())


def test_menu_opens_and_goes_away(qgis: Any, plugin: Any, run: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    from qgis.core import QgsApplication
    from qgis.PyQt.QtGui import QGuiApplication
    from qgis.PyQt.QtWidgets import QMainWindow

    main = plugin("plugin.main")
    opened: list[str] = []
    monkeypatch.setattr(main.QDesktopServices, "openUrl", lambda url: opened.append(url.toLocalFile()))
    monkeypatch.setattr(qgis, "execAlgorithmDialog", lambda name, parameters: opened.append(name))

    class Interface:
        def __init__(self) -> None:
            self.window, self.menu, self.toolbar, self.said = QMainWindow(), [], [], []

        def mainWindow(self) -> Any:
            return self.window

        def messageBar(self) -> Any:
            return self

        def pushMessage(self, title: str, text: str) -> None:
            self.said.append(text)

        def addPluginToMenu(self, menu: str, action: Any) -> None:
            self.menu.append(action)

        def addToolBarIcon(self, action: Any) -> None:
            self.toolbar.append(action)

        def removePluginMenu(self, menu: str, action: Any) -> None:
            self.menu.remove(action)

        def removeToolBarIcon(self, action: Any) -> None:
            if action in self.toolbar:
                self.toolbar.remove(action)

    monkeypatch.setattr(main.OnTheFly3RPlugin, "initProcessing", lambda self: None)
    plugin("plugin.settings").save_run(run["OUTPUT"])
    asked: list[Any] = []
    monkeypatch.setattr(qgis, "runAndLoadResults", lambda *words: asked.append(words))
    interface = Interface()
    shown = main.OnTheFly3RPlugin(interface)
    shown.initGui()
    assert len(interface.menu) == 7 and len(interface.toolbar) == 1
    assert not any(action.icon().isNull() for action in interface.menu)
    for action in interface.menu:
        action.trigger()
    names = ["onthefly3r:reconstruct", "onthefly3r:sampleflight", run["REPORT"], "onthefly3r:setup"]
    assert opened[:4] == names and opened[4].endswith(".html") and len(opened) == 5
    recent = interface.menu[3].menu()
    recent.aboutToShow.emit()
    assert recent.actions()[0].text() == run["OUTPUT"]
    recent.actions()[0].trigger()
    assert asked == [("onthefly3r:loadresults", {"RUN": run["OUTPUT"]})]
    assert interface.said == ["Copied."] or interface.said == ["No failure has been noted."]
    plugin("plugin.settings").save_diagnostics("what happened")
    interface.menu[6].trigger()
    assert QGuiApplication.clipboard().text() == "what happened"
    shown.unload()
    assert not interface.menu and not interface.toolbar
    assert QgsApplication.processingRegistry().providerById("onthefly3r") is not None
