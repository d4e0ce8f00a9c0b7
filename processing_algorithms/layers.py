"""The results of a run as layers: sinks filled from its files, styled and grouped where QGIS shows them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsFeature,
    QgsFeatureSink,
    QgsField,
    QgsFields,
    QgsGeometry,
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFeatureSink,
    QgsVectorLayer,
    QgsWkbTypes,
)
from qgis.PyQt.QtCore import QVariant

from .base import tr
from .field_types import REAL, TEXT, TRUTH, WHOLE
from .parameters import add
from .presentation import show
from .survey import HEIGHTS, survey_title, table_uri

CAMERAS, REJECTED, FOOTPRINTS = "CAMERAS", "REJECTED", "FOOTPRINTS"
MAX_REPORT_BYTES = 64 * 1024 * 1024

CAMERA_FIELDS = (
    ("image", TEXT),
    ("number", WHOLE),
    *((name, TEXT) for name in ("status", "reason")),
    *((name, REAL) for name in ("x", "y", "z", "omega", "phi", "kappa", "yaw", "pitch", "roll")),
    *((name, REAL) for name in ("gps_x", "gps_y", "gps_z", "dx", "dy", "dz", "d_h", "d_3d", "sig_h", "sig_v")),
    *((name, REAL) for name in ("sd_h", "sd_v", "sd_deg")),
    ("rtk", WHOLE),
    ("used", TRUTH),
    ("retries", WHOLE),
    ("batch", WHOLE),
    ("t_utc", TEXT),
    ("cam", TEXT),
    ("path", TEXT),
)
REJECTED_FIELDS = (
    *((name, TEXT) for name in ("image", "stage", "reason")),
    *((name, REAL) for name in ("gps_x", "gps_y", "gps_z")),
    ("retries", WHOLE),
    ("t_utc", TEXT),
    ("cam", TEXT),
    ("path", TEXT),
)
FOOTPRINT_FIELDS = (("image", TEXT), ("number", WHOLE), ("gsd_m", REAL), ("area_m2", REAL), ("overlap", WHOLE))

Row = tuple[dict[str, Any], "QgsGeometry | None"]


def make_fields(described: Iterable[tuple[str, Any]]) -> QgsFields:
    """Return QGIS fields of (name, type)."""
    fields = QgsFields()
    for name, kind in described:
        fields.append(QgsField(name, kind))
    return fields


def add_camera_sinks(algorithm: QgsProcessingAlgorithm, by_default: bool = True) -> None:
    """Add the layers that every run has; `by_default` makes them where the dialog is left as it is."""
    point, polygon = QgsProcessing.SourceType.TypeVectorPoint, QgsProcessing.SourceType.TypeVectorPolygon
    add(
        algorithm,
        _sink(CAMERAS, tr("Cameras"), point, by_default),
        tr("Where each placed photograph was taken, its angles, and how far its tagged position is from there."),
        advanced=not by_default,
    )
    add(
        algorithm,
        _sink(REJECTED, tr("Rejected photographs"), point, by_default),
        tr("What could not be used, with the reason; at the tagged position, or without geometry where there is none."),
        advanced=not by_default,
    )
    add(
        algorithm,
        _sink(FOOTPRINTS, tr("Footprints"), polygon, by_default),
        tr("The ground that each placed photograph covers, and how many photographs cover its middle."),
        advanced=not by_default,
    )


def _sink(name: str, title: str, kind: Any, by_default: bool) -> QgsProcessingParameterFeatureSink:
    return QgsProcessingParameterFeatureSink(name, title, kind, None, True, by_default)


def read_report(path: Path) -> dict[str, Any]:
    """Return a run's report; raises `QgsProcessingException` when there is none."""
    try:
        if path.stat().st_size > MAX_REPORT_BYTES:
            raise ValueError(f"larger than {MAX_REPORT_BYTES} bytes")
        report = json.loads(path.read_text(encoding="utf-8"))
        report["images"]["placed"]
        return report
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise QgsProcessingException(tr("{} cannot be read ({}).").format(path, error)) from error


def fill_camera_sinks(
    algorithm: QgsProcessingAlgorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    feedback: QgsProcessingFeedback,
    run: Path,
    photos: Path | None,
) -> dict[str, Any]:
    """Fill the sinks of `add_camera_sinks` from the files of a run and return their destinations.

    Layers that QGIS loads come into the group of the survey; `photos` is the folder of its photographs, if known.
    """
    report = read_report(run / "report.json")
    crs = run_crs(report)
    cameras = list(read_rows(run / "cameras.shp", CAMERA_FIELDS))
    placed = [row for row in cameras if row[0]["status"] == "placed"]
    footprints = list(read_footprints(run))
    rejected = rejected_rows(report, cameras)
    for values, _ in (*cameras, *rejected) if photos is not None else ():
        values["path"] = str(photos.absolute() / values["image"])
    sinks = (
        (CAMERAS, CAMERA_FIELDS, QgsWkbTypes.Type.PointZ, placed, "cameras.qml"),
        (REJECTED, REJECTED_FIELDS, QgsWkbTypes.Type.PointZ, rejected, "rejected.qml"),
        (FOOTPRINTS, FOOTPRINT_FIELDS, QgsWkbTypes.Type.Polygon, footprints, "footprints.qml"),
    )
    results: dict[str, Any] = {}
    for name, fields, geometry, rows, style in sinks:
        if parameters.get(name) in (None, ""):
            continue
        results[name] = fill_sink(algorithm, parameters, context, name, fields, geometry, crs, rows)
        show(context, results[name], survey_title(run, photos), style, HEIGHTS[name.lower()])
        feedback.pushInfo(f"{algorithm.parameterDefinition(name).description()}: {len(rows)}")
    return results


def fill_sink(
    algorithm: QgsProcessingAlgorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    name: str,
    described: Iterable[tuple[str, Any]],
    geometry_type: Any,
    crs: QgsCoordinateReferenceSystem,
    rows: Iterable[Row],
) -> str:
    """Write rows into a sink and return its destination."""
    fields = make_fields(described)
    sink, destination = algorithm.parameterAsSink(parameters, name, context, fields, geometry_type, crs)
    if sink is None:
        raise QgsProcessingException(algorithm.invalidSinkError(parameters, name))
    names = [field.name() for field in fields]
    for values, geometry in rows:
        feature = QgsFeature(fields)
        feature.setAttributes([values.get(name) for name in names])
        if geometry is not None:
            feature.setGeometry(geometry)
        if not sink.addFeature(feature, QgsFeatureSink.Flag.FastInsert):
            raise QgsProcessingException(algorithm.writeFeatureError(sink, parameters, name))
    del sink  # closes the file
    return destination


def run_crs(report: dict[str, Any]) -> QgsCoordinateReferenceSystem:
    """Return the CRS of a run, an invalid one for a run in map units."""
    crs, geo = QgsCoordinateReferenceSystem(), report.get("georeference")
    if geo and not crs.createFromUserInput(geo["crs"]):
        raise QgsProcessingException(tr("QGIS does not know the coordinate reference system {}.").format(geo["crs"]))
    return crs


def read_footprints(run: Path) -> Iterable[Row]:
    """Yield the footprints of a run."""
    return read_rows(table_uri(run, "footprints"), FOOTPRINT_FIELDS)


def read_rows(uri: Path | str, described: Iterable[tuple[str, Any]]) -> Iterable[Row]:
    """Yield attributes and geometry of a table's features, nothing where it is missing."""
    if not uri or not Path(str(uri).partition("|")[0]).is_file():
        return
    layer = QgsVectorLayer(str(uri), "rows", "ogr")
    if not layer.isValid():
        raise QgsProcessingException(tr("{} cannot be read.").format(uri))
    convert: dict[Any, Callable[[Any], Any]] = {TEXT: str, REAL: float, WHOLE: int, TRUTH: _truth}
    kinds = dict(described)
    known = [field.name() for field in layer.fields()]
    for feature in layer.getFeatures():
        values = {name: feature.attribute(name) for name in known}
        row = {
            name: None if _is_null(values.get(name)) else convert[kind](values[name]) for name, kind in kinds.items()
        }
        geometry = QgsGeometry(feature.geometry())
        geometry.convertToSingleType()  # shapefiles do not tell polygons from multipolygons
        yield row, geometry


def rejected_rows(report: dict[str, Any], cameras: Iterable[Row]) -> list[Row]:
    """Return all rejected photographs of a report; those with a tagged position have a geometry."""
    known = {values["image"]: (values, geometry) for values, geometry in cameras if values["status"] == "rejected"}
    rows = []
    for item in report["images"]["rejected"]:
        values, geometry = known.get(item["image"], ({}, None))
        rows.append(({**values, "image": item["image"], "stage": item["stage"], "reason": item["reason"]}, geometry))
    return rows


def _is_null(value: Any) -> bool:
    return value is None or (isinstance(value, QVariant) and value.isNull())


def _truth(value: Any) -> bool:
    """Some versions of GDAL give the shapefile's logical field as text."""
    return value in (True, 1, "T", "t", "Y", "y", "1")
