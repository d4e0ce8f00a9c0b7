"""How results look in the project: styles, groups, and the point cloud where QGIS can show it; main thread only."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    Qgis,
    QgsApplication,
    QgsContrastEnhancement,
    QgsEditorWidgetSetup,
    QgsExpression,
    QgsField,
    QgsMapLayer,
    QgsPointCloudRgbRenderer,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingLayerPostProcessorInterface,
    QgsProcessingUtils,
    QgsProject,
    QgsRasterBandStats,
    QgsSingleBandPseudoColorRenderer,
    QgsStyle,
    QgsVectorLayer,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QTimer

from .base import ROOT, tr
from .field_types import TEXT
from .survey import has_unreadable_cloud, survey_layers, survey_title

STYLES = ROOT / "core" / "onthefly3r" / "products" / "styles"
HEIGHT_PROPERTY = "onthefly3r/height"  # of a layer: those with the greater one lie above the others
DEEP_COLOUR = 65535.0  # LAS tells colours in 16 bits
TRIES, AGAIN_MS = 10, 200
HEIGHT_COLOURS = "Viridis"


class Presentation(QgsProcessingLayerPostProcessorInterface):
    """Styles a layer that was loaded and puts it into the group of its run; works in the main thread."""

    kept: ClassVar[list[Presentation]] = []  # QGIS holds no reference of its own
    MOST_KEPT = 200

    def __init__(self, group: str, style: str, height: int = 0, shown: bool = True, photos: Path | None = None) -> None:
        super().__init__()
        self._group, self._style, self._height, self._shown, self._photos = group, style, height, shown, photos
        Presentation.kept[:] = [*Presentation.kept[1 - self.MOST_KEPT :], self]

    def postProcessLayer(self, layer: QgsMapLayer, context: QgsProcessingContext, feedback: Any) -> None:
        """Style and group `layer`."""
        layer.setCustomProperty(HEIGHT_PROPERTY, self._height)
        if self._style == "cloud":
            colour_cloud(layer)
        elif self._style == "heights":
            colour_heights(layer)
        elif self._style and not _has_style_of_its_own(layer):
            layer.loadNamedStyle(str(STYLES / self._style))
        if isinstance(layer, QgsVectorLayer):
            show_photographs(layer, self._photos)
        layer.triggerRepaint()
        project = context.project() or QgsProject.instance()
        group_into(project, layer, self._group)
        if not self._shown:
            switch_off(project, layer.id())


def group_into(project: QgsProject, layer: QgsMapLayer, name: str) -> None:
    """Move a layer of the project to its place in a group, which is made where it is missing."""
    root = project.layerTreeRoot()
    node = root.findLayer(layer.id())
    if node is None or not name:
        return
    group = root.findGroup(name) or root.insertGroup(0, name)
    # QGIS may have put it into the group already, for it adds layers beside the selected one. The copy comes first:
    # a layer that is nowhere in the tree is removed from the project.
    group.insertChildNode(_place(layer, group), node.clone())
    node.parent().removeChildNode(node)


def switch_off(project: QgsProject, layer_id: str, tries: int = TRIES) -> None:
    """Switch a layer off in the layer tree; from QGIS 3.32 on it comes into the tree only after this is called."""
    node = project.layerTreeRoot().findLayer(layer_id)
    if node is not None:
        node.setItemVisibilityChecked(False)
    elif tries > 0:
        QTimer.singleShot(AGAIN_MS, lambda: switch_off(project, layer_id, tries - 1))


def _place(layer: QgsMapLayer, group: Any) -> int:
    """Return where in a group a layer comes: behind the last one that lies above it."""
    place = 0
    for number, node in enumerate(group.children()):
        other = node.layer() if hasattr(node, "layer") else None
        if other is not None and other.id() != layer.id() and _height(other) >= _height(layer):
            place = number + 1
    return place


def _height(layer: QgsMapLayer) -> int:
    return int(layer.customProperty(HEIGHT_PROPERTY, 0))


def _has_style_of_its_own(layer: QgsMapLayer) -> bool:
    """Return whether a layer of a GeoPackage was loaded with a style that is stored there."""
    if not isinstance(layer, QgsVectorLayer) or ".gpkg|" not in layer.source():
        return False
    return bool(layer.listStylesInDatabase()[0] > 0)


def show_photographs(layer: QgsVectorLayer, photos: Path | None) -> None:
    """Let a click on a camera show its photograph; where there is no field with its path, one is worked out."""
    names = [field.name() for field in layer.fields()]
    if "image" not in names or layer.geometryType() == QgsWkbTypes.GeometryType.PolygonGeometry:
        return
    if "path" not in names:
        if photos is None:
            return
        folder = QgsExpression.quotedString(f"{photos.absolute().as_posix().rstrip('/')}/")
        layer.addExpressionField(f'{folder} || "image"', QgsField("path", TEXT))
    picture = {"DocumentViewer": 1, "DocumentViewerWidth": 0, "DocumentViewerHeight": 360, "FileWidget": True}
    layer.setEditorWidgetSetup(layer.fields().indexOf("path"), QgsEditorWidgetSetup("ExternalResource", picture))


def colour_cloud(layer: QgsMapLayer) -> None:
    """Paint a cloud in its colours; the range of 16-bit colours is told, for without it all points are white."""
    if layer.dataProvider() is None or layer.attributes().indexOf("Red") < 0:
        return
    renderer = _default_cloud_renderer(layer)
    if renderer is None or renderer.type() != "rgb":
        renderer = QgsPointCloudRgbRenderer()
        renderer.setRedAttribute("Red")
        renderer.setGreenAttribute("Green")
        renderer.setBlueAttribute("Blue")
    if renderer.redContrastEnhancement() is None:
        for set_contrast in (
            renderer.setRedContrastEnhancement,
            renderer.setGreenContrastEnhancement,
            renderer.setBlueContrastEnhancement,
        ):
            contrast = QgsContrastEnhancement(Qgis.DataType.UInt16)
            contrast.setContrastEnhancementAlgorithm(
                QgsContrastEnhancement.ContrastEnhancementAlgorithm.StretchToMinimumMaximum
            )
            contrast.setMinimumValue(0.0)
            contrast.setMaximumValue(DEEP_COLOUR)
            set_contrast(contrast)
    layer.setRenderer(renderer)


def _default_cloud_renderer(layer: QgsMapLayer) -> Any:
    registry = QgsApplication.pointCloudRendererRegistry()
    try:
        return registry.defaultRenderer(layer)
    except TypeError:  # before QGIS 3.26
        return registry.defaultRenderer(layer.dataProvider())


def colour_heights(layer: QgsMapLayer) -> None:
    """Paint a surface by its heights."""
    provider = layer.dataProvider()
    wanted = QgsRasterBandStats.Stats.Min | QgsRasterBandStats.Stats.Max
    stats = provider.bandStatistics(1, wanted, layer.extent(), 250_000)
    ramp = QgsStyle.defaultStyle().colorRamp(HEIGHT_COLOURS)
    if ramp is None or not stats.minimumValue < stats.maximumValue:
        return
    renderer = QgsSingleBandPseudoColorRenderer(provider, 1)
    renderer.setClassificationMin(stats.minimumValue)
    renderer.setClassificationMax(stats.maximumValue)
    renderer.createShader(ramp)
    layer.setRenderer(renderer)


def show(context: QgsProcessingContext, destination: str, group: str, style: str, height: int = 0) -> None:
    """Give a layer that will be loaded its style and group."""
    if context.willLoadLayerOnCompletion(destination):
        _present(context.layerToLoadOnCompletionDetails(destination), Presentation(group, style, height), group, height)


def _present(details: QgsProcessingContext.LayerDetails, presentation: Presentation, group: str, height: int) -> None:
    details.setPostProcessor(presentation)
    if hasattr(details, "groupName"):  # from 3.32 on QGIS groups and orders itself, after the post-processing
        details.groupName = group
        details.layerSortKey = height


def load_survey(context: QgsProcessingContext, feedback: QgsProcessingFeedback, run: Path, photos: Path | None) -> None:
    """Ask QGIS to load all layers of a run from its files, in their order and group."""
    project, group = context.project(), survey_title(run, photos)
    hints = QgsProcessingUtils.LayerHint
    kinds = {"vector": hints.Vector, "raster": hints.Raster, "cloud": hints.PointCloud}
    if project is None:
        return
    for layer in survey_layers(run):
        details = QgsProcessingContext.LayerDetails(layer.title, project, layer.name.upper(), kinds[layer.kind])
        details.forceName = True
        presentation = Presentation(group, layer.style, layer.height, layer.shown, photos)
        _present(details, presentation, group, layer.height)
        context.addLayerToLoadOnCompletion(layer.uri, details)
    if has_unreadable_cloud(run):
        feedback.pushInfo(
            tr("This QGIS has no reader for point clouds (LAS, LAZ, COPC): the cloud is a file in {}.").format(run)
        )
