"""What every run gives: its files and figures as outputs, its photographs as layers."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputHtml,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
)

from ..plugin import settings
from .base import CoreAlgorithm, tr
from .layers import add_camera_sinks, fill_camera_sinks, read_footprints, read_report
from .parameters import add
from .presentation import load_survey
from .survey import GEOPACKAGE

LOAD_RESULTS = "LOAD_RESULTS"
RASTERS = {"ORTHOPHOTO": "Orthophoto", "DSM": "Surface model", "DTM": "Terrain model"}
FEW_PLACED = 0.9


def add_run_outputs(algorithm: CoreAlgorithm) -> None:
    """Declare the layers, files and numbers that every run gives."""
    add(
        algorithm,
        QgsProcessingParameterBoolean(LOAD_RESULTS, tr("Load the results into the project"), defaultValue=True),
        tr(
            "Adds the layers from the files in the output folder, in a group named after the survey: rejected "
            "photographs, cameras, footprints, orthophoto, point cloud, surface model, as far as they were made."
        ),
    )
    add_camera_sinks(algorithm, by_default=False)
    algorithm.addOutput(QgsProcessingOutputFile("CLOUD", tr("Point cloud file")))
    algorithm.addOutput(QgsProcessingOutputFile("GEOPACKAGE", tr("GeoPackage of the survey")))
    for name, title in RASTERS.items():
        algorithm.addOutput(QgsProcessingOutputRasterLayer(name, tr(title)))
    algorithm.addOutput(QgsProcessingOutputHtml("REPORT", tr("Report")))
    algorithm.addOutput(QgsProcessingOutputString("CRS_OUT", tr("Coordinate reference system of the results")))
    for name, title in (
        ("GIVEN", tr("Photographs given")),
        ("PLACED", tr("Photographs placed")),
        ("RMSE_H", tr("Position residuals, horizontal RMS [m]")),
        ("RMSE_V", tr("Position residuals, vertical RMS [m]")),
        ("POINTS", tr("Points")),
        ("SPACING", tr("Mean distance of points [m]")),
        ("GSD", tr("Ground sampling distance of the photographs [m]")),
    ):
        algorithm.addOutput(QgsProcessingOutputNumber(name, title))


def run_results(run: Path) -> dict[str, Any]:
    """Return the files and numbers of `add_run_outputs`; what a run lacks is None."""
    report = read_report(run / "report.json")
    geo, cloud = report["georeference"] or {}, report["cloud"] or {}
    sampling = [values["gsd_m"] for values, _ in read_footprints(run) if values["gsd_m"] is not None]
    return {
        "CLOUD": str(run / cloud["path"]) if cloud else None,
        "GEOPACKAGE": _existing(run / GEOPACKAGE),
        **{name: _existing(run / f"{name.lower()}.tif") for name in RASTERS},
        "REPORT": str(run / "report.html"),
        "CRS_OUT": geo.get("crs", ""),
        "GIVEN": report["images"]["given"],
        "PLACED": report["images"]["placed"],
        "RMSE_H": geo.get("rmse_h_m"),
        "RMSE_V": geo.get("rmse_v_m"),
        "POINTS": cloud.get("points"),
        "SPACING": cloud.get("mean_spacing_m"),
        "GSD": median(sampling) if sampling and geo else None,
    }


def hand_over(
    algorithm: CoreAlgorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    feedback: QgsProcessingFeedback,
    run: Path,
    photos: Path | None,
) -> dict[str, Any]:
    """Fill the layers from the files of a finished run and return all outputs of `add_run_outputs`."""
    results = run_results(run)
    settings.save_run(str(run))
    say_results(results, feedback)
    algorithm.warn(warnings_of(read_report(run / "report.json")), feedback)
    layers = fill_camera_sinks(algorithm, parameters, context, feedback, run, photos)
    if algorithm.parameterAsBoolean(parameters, LOAD_RESULTS, context):
        load_survey(context, feedback, run, photos)
    return {**results, **layers}


def warnings_of(report: dict[str, Any]) -> list[str]:
    """Return what a report warns of; that few photographs were placed comes first, whether or not it says so."""
    told = [str(warning) for warning in report.get("warnings") or ()]
    given, placed = report["images"]["given"], report["images"]["placed"]
    if placed < FEW_PLACED * given and not any(str(placed) in text and str(given) in text for text in told):
        few = tr("Only {} of {} photographs were placed: see the rejected ones and their reasons.")
        told.insert(0, few.format(placed, given))
    return list(dict.fromkeys(told))


def _existing(path: Path) -> str | None:
    return str(path) if path.is_file() else None


def say_results(results: dict[str, Any], feedback: QgsProcessingFeedback) -> None:
    """Put what a person wants to know first into the log."""
    feedback.pushInfo(tr("Placed {PLACED} of {GIVEN} photographs.").format(**results))
    if results["RMSE_H"] is not None:
        feedback.pushInfo(
            tr("Residuals of the positions: {RMSE_H:.2f} m horizontally, {RMSE_V:.2f} m vertically (RMS). ").format(
                **results
            )
            + tr("They are not the accuracy: that needs checkpoints.")
        )
    feedback.pushInfo(tr("Report: {REPORT}").format(**results))
