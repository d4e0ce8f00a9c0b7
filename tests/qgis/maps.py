"""Maps rendered for tests."""

from __future__ import annotations

from typing import Any

SIDE_PX = 600


def render(layers: list[Any], extent: Any) -> Any:
    """Return a picture (QImage, square, white where nothing is) of layers, the first on top."""
    from qgis.core import QgsMapRendererSequentialJob, QgsMapSettings
    from qgis.PyQt.QtCore import QSize
    from qgis.PyQt.QtGui import QColor

    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(layers[0].crs())
    settings.setBackgroundColor(QColor("white"))
    settings.setOutputSize(QSize(SIDE_PX, SIDE_PX))
    settings.setExtent(extent)
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    return job.renderedImage()


def seen_at(picture: Any, extent: Any, point: Any, reach_px: int) -> bool:
    """Return whether something is drawn within a few pixels of a point of the map."""
    unit = max(extent.width(), extent.height()) / SIDE_PX
    column = SIDE_PX / 2 + (point.x() - extent.center().x()) / unit
    row = SIDE_PX / 2 - (point.y() - extent.center().y()) / unit
    return any(
        picture.pixel(round(column) + across, round(row) + down) != 0xFFFFFFFF
        for across in range(-reach_px, reach_px + 1)
        for down in range(-reach_px, reach_px + 1)
    )
