"""Reconstruct photographs: a folder in, cloud, cameras, footprints and report out."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputHtml,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
)

from ..core.onthefly3r.protocol import Job
from ..plugin import settings
from .base import CoreAlgorithm, tr
from .boundary import add_boundary, boundary_file
from .layers import (
    FOOTPRINT_FIELDS,
    add_camera_sinks,
    fill_camera_sinks,
    load_cloud,
    read_report,
    read_rows,
    remove_stale_index,
)
from .parameters import add, add_backbone, add_crs, add_options, add_quality, options_from, require_folder

PHOTOS, OUTPUT, LOAD_CLOUD = "PHOTOS", "OUTPUT", "LOAD_CLOUD"


def add_run_outputs(algorithm: CoreAlgorithm) -> None:
    """Declare the files and numbers that every run gives."""
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


class ReconstructPhotographs(CoreAlgorithm):
    """The main algorithm: `onthefly3r run`."""

    NAME = "reconstruct"
    TITLE = "Reconstruct photographs"
    ICON = "reconstruct.svg"
    HELP = (
        "Makes a georeferenced point cloud, camera positions, footprints and a report from a folder of drone "
        "photographs.\n\nThe photographs need positions in their tags (GPS), overlap of about 70 % along and 60 % "
        "across the flight lines, and texture; water and uniform fields stay empty. Photographs that do not fit are "
        "put aside with the reason.\n\nTo see whether a flight is complete, run it with the quality 'preview' first. "
        "All files are in the output folder: cloud.laz, cameras.shp, footprints.shp, report.html, preview.png, "
        "trajectory.csv and a COLMAP model; the other algorithms of this group take that folder.\n\nAbsolute accuracy "
        "is that of the drone's receiver: metres without RTK."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        add(
            self,
            QgsProcessingParameterFile(PHOTOS, tr("Folder of photographs"), QgsProcessingParameterFile.Folder),
            tr("JPEG, PNG or TIFF as they come from the drone; sub-folders are searched. Nothing is written there."),
        )
        add_quality(self)
        add_crs(self)
        add_boundary(self)
        add_backbone(self)
        add_options(self)
        add(
            self,
            QgsProcessingParameterBoolean(LOAD_CLOUD, tr("Load the point cloud"), defaultValue=True),
            tr("Add the cloud to the project, where this QGIS can read LAS files."),
            advanced=True,
        )
        add(
            self,
            QgsProcessingParameterFolderDestination(OUTPUT, tr("Output folder")),
            tr("Empty or of an earlier run, whose files are replaced. About 5 MB per photograph while computing."),
        )
        add_camera_sinks(self)
        add_run_outputs(self)

    def checkParameterValues(self, parameters: dict[str, Any], context: QgsProcessingContext) -> tuple[bool, str]:
        """Tell wrong folders before anything starts."""
        try:
            require_folder(self.parameterAsString(parameters, PHOTOS, context), tr("Folder of photographs"))
            options_from(self, parameters, context)
        except QgsProcessingException as error:
            return False, str(error)
        return super().checkParameterValues(parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the job, then fill the layers."""
        photos = require_folder(self.parameterAsString(parameters, PHOTOS, context), tr("Folder of photographs"))
        run = Path(self.parameterAsString(parameters, OUTPUT, context))
        options = options_from(self, parameters, context)
        remove_stale_index(run / "cloud.laz")
        with boundary_file(self, parameters, context) as boundary:
            self.run_core(Job("run", (str(photos), str(run)), {**options, "boundary": boundary}), feedback)
        results = run_results(run)
        settings.save_last_report(results["REPORT"])
        say_results(results, feedback)
        layers = fill_camera_sinks(self, parameters, context, feedback, run)
        if results["CLOUD"] and self.parameterAsBoolean(parameters, LOAD_CLOUD, context):
            load_cloud(context, feedback, results["CLOUD"], run.name)
        return {OUTPUT: str(run), **results, **layers}
