"""The part of the ground that the cloud is cut to: a layer or an extent, handed to the core as GeoJSON."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsFeatureRequest,
    QgsGeometry,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingParameterExtent,
    QgsProcessingParameterFeatureSource,
)

from .base import tr
from .parameters import add

BOUNDARY, EXTENT = "BOUNDARY", "EXTENT"
EDGE_POINTS = 20  # points per edge of an extent, so that its edges stay straight in its own CRS


def add_boundary(algorithm: QgsProcessingAlgorithm) -> None:
    """Add a boundary layer and an extent, both optional."""
    add(
        algorithm,
        QgsProcessingParameterFeatureSource(
            BOUNDARY, tr("Boundary layer"), [QgsProcessing.SourceType.TypeVectorPolygon], optional=True
        ),
        tr("Points outside its polygons are left out of the cloud. All photographs are used all the same."),
    )
    add(
        algorithm,
        QgsProcessingParameterExtent(EXTENT, tr("Extent"), optional=True),
        tr("Points outside it are left out of the cloud; together with a boundary layer, what lies in both is kept."),
    )


@contextlib.contextmanager
def boundary_file(
    algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> Iterator[str | None]:
    """Yield the path of a GeoJSON file (WGS 84) of what the cloud is cut to, None when it is not cut."""
    area = area_of(algorithm, parameters, context)
    if area is None:
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="onthefly3r-") as folder:
        path = Path(folder) / "boundary.geojson"
        feature = {"type": "Feature", "properties": {}, "geometry": json.loads(area.asJson(12))}
        path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")
        yield str(path)


def area_of(
    algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> QgsGeometry | None:
    """Return boundary and extent as one geometry in longitude and latitude, None where neither is named.

    Raises `QgsProcessingException` for what is no area.
    """
    area = _named_area(algorithm, parameters, context)
    if area is not None and area.isEmpty():
        raise QgsProcessingException(tr("The boundary holds no ground: no polygons, or none in the extent."))
    return area


def _named_area(
    algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> QgsGeometry | None:
    wgs84 = QgsCoordinateReferenceSystem("EPSG:4326")
    area = None
    source = algorithm.parameterAsSource(parameters, BOUNDARY, context)
    if source is None and parameters.get(BOUNDARY) not in (None, ""):
        raise QgsProcessingException(
            tr("The boundary layer {} cannot be read, or is no layer of polygons.").format(parameters[BOUNDARY])
        )
    if source is not None:
        if not source.sourceCrs().isValid():
            raise QgsProcessingException(tr("The boundary layer has no coordinate reference system: set it first."))
        request = QgsFeatureRequest().setDestinationCrs(wgs84, context.transformContext())
        area = QgsGeometry.unaryUnion([feature.geometry() for feature in source.getFeatures(request)])
    if parameters.get(EXTENT) not in (None, ""):
        crs = algorithm.parameterAsExtentCrs(parameters, EXTENT, context)
        if algorithm.parameterAsExtent(parameters, EXTENT, context).isNull():
            raise QgsProcessingException(
                tr("{} is no extent: write it as xmin,xmax,ymin,ymax [EPSG:32633].").format(parameters[EXTENT])
            )
        if not crs.isValid():
            raise QgsProcessingException(
                tr("The extent has no coordinate reference system: add it, as in [EPSG:32633].")
            )
        rectangle = QgsGeometry.fromRect(algorithm.parameterAsExtent(parameters, EXTENT, context, crs))
        rectangle = rectangle.densifyByCount(EDGE_POINTS)
        rectangle.transform(QgsCoordinateTransform(crs, wgs84, context.transformContext()))
        area = rectangle if area is None else area.intersection(rectangle)
    return area
