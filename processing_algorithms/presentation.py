"""How results look in the project: styles, groups, and the point cloud where QGIS can show it; main thread only."""

from __future__ import annotations

from typing import Any, ClassVar

from qgis.core import (
    QgsMapLayer,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingLayerPostProcessorInterface,
    QgsProcessingUtils,
    QgsProject,
    QgsProviderRegistry,
    QgsVectorLayer,
    QgsWkbTypes,
)

from .base import ROOT, tr

STYLES = ROOT / "resources" / "styles"
HEIGHT, POINTS = {"cloud": 0, "footprints.qml": 1}, 2  # layers with the greater figure lie above the others


class Presentation(QgsProcessingLayerPostProcessorInterface):
    """Styles a layer that was loaded and puts it into the group of its run; works in the main thread."""

    kept: ClassVar[list[Presentation]] = []  # QGIS holds no reference of its own
    MOST_KEPT = 200

    def __init__(self, group: str, style: str) -> None:
        super().__init__()
        self._group, self._style = group, style
        Presentation.kept[:] = [*Presentation.kept[1 - self.MOST_KEPT :], self]

    def postProcessLayer(self, layer: QgsMapLayer, context: QgsProcessingContext, feedback: Any) -> None:
        """Style and group `layer`."""
        if self._style == "cloud":
            _colour_cloud(layer)
        elif self._style:
            layer.loadNamedStyle(str(STYLES / self._style))
        layer.triggerRepaint()
        project = context.project() or QgsProject.instance()
        group_into(project, layer, self._group)


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


def _place(layer: QgsMapLayer, group: Any) -> int:
    """Points above polygons above clouds."""
    polygon = QgsWkbTypes.GeometryType.PolygonGeometry
    on_top = isinstance(layer, QgsVectorLayer) and layer.geometryType() != polygon
    return 0 if on_top else len(group.children())


def _colour_cloud(layer: QgsMapLayer) -> None:
    import qgis.core

    renderer = getattr(qgis.core, "QgsPointCloudRgbRenderer", None)
    if renderer is not None and hasattr(layer, "setRenderer"):
        layer.setRenderer(renderer())


def show(context: QgsProcessingContext, destination: str, group: str, style: str) -> None:
    """Give a layer that will be loaded its style and group."""
    if context.willLoadLayerOnCompletion(destination):
        _present(context.layerToLoadOnCompletionDetails(destination), group, style)


def _present(details: QgsProcessingContext.LayerDetails, group: str, style: str) -> None:
    details.setPostProcessor(Presentation(group, style))
    if hasattr(details, "groupName"):  # from 3.32 on QGIS groups and orders itself, after the post-processing
        details.groupName = group
        details.layerSortKey = HEIGHT.get(style, POINTS)


def load_cloud(context: QgsProcessingContext, feedback: QgsProcessingFeedback, path: str, group: str) -> None:
    """Ask QGIS to load a point cloud, or say why it cannot."""
    if "pdal" not in QgsProviderRegistry.instance().providerList():
        feedback.pushInfo(tr("This QGIS has no reader for LAS files (PDAL): the point cloud is in {}.").format(path))
        return
    project = context.project()
    if project is None:
        return
    details = QgsProcessingContext.LayerDetails(
        tr("Point cloud"), project, "CLOUD", QgsProcessingUtils.LayerHint.PointCloud
    )
    details.forceName = True
    _present(details, group, "cloud")
    context.addLayerToLoadOnCompletion(path, details)
