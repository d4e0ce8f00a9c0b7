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
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
)

from ..plugin import settings
from .base import CoreAlgorithm, tr
from .layers import FOOTPRINT_FIELDS, add_camera_sinks, fill_camera_sinks, read_report, read_rows
from .parameters import add
from .presentation import load_cloud

LOAD_CLOUD = "LOAD_CLOUD"


def add_run_outputs(algorithm: CoreAlgorithm) -> None:
    """Declare the layers, files and numbers that every run gives."""
    add_camera_sinks(algorithm)
    add(
        algorithm,
        QgsProcessingParameterBoolean(LOAD_CLOUD, tr("Load the point cloud"), defaultValue=True),
        tr("Add the cloud to the project, where this QGIS can read LAS files."),
        advanced=True,
    )
    algorithm.addOutput(QgsProcessingOutputFile("CLOUD", tr("Point cloud file")))
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
    sampling = [values["gsd_m"] for values, _ in read_rows(run / "footprints.shp", FOOTPRINT_FIELDS)]
    return {
        "CLOUD": str(run / cloud["path"]) if cloud else None,
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
) -> dict[str, Any]:
    """Fill the layers from the files of a finished run and return all outputs of `add_run_outputs`."""
    results = run_results(run)
    settings.save_last_report(results["REPORT"])
    say_results(results, feedback)
    layers = fill_camera_sinks(algorithm, parameters, context, feedback, run, run.name)
    if results["CLOUD"] and algorithm.parameterAsBoolean(parameters, LOAD_CLOUD, context):
        load_cloud(context, feedback, results["CLOUD"], run.name)
    return {**results, **layers}


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
