"""Export cameras: photographs of an earlier run as layers or files of any vector format."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputNumber,
)

from .base import tr
from .earlier_run import EarlierRunAlgorithm
from .layers import add_camera_sinks, fill_camera_sinks, read_report, run_crs
from .parameters import CRS, add_target_crs, options_from
from .survey import photographs_folder


class ExportCameras(EarlierRunAlgorithm):
    """Cameras, rejected photographs and footprints, in another CRS by `onthefly3r export --no-cloud`."""

    NAME = "exportcameras"
    TITLE = "Export cameras"
    ICON = "cameras.svg"
    HELP = (
        "Writes the camera positions of an earlier run, with their angles and residuals, its rejected photographs and "
        "its footprints: as shapefile, GeoPackage or whatever the outputs are named, and in another projected "
        "coordinate reference system when one is named. Angles are turned along: omega, phi and kappa belong to the "
        "grid of the coordinate reference system."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        self.add_run()
        add_target_crs(self, again=True)
        add_camera_sinks(self)
        self.addOutput(QgsProcessingOutputNumber("PLACED", tr("Photographs placed")))
        self.addOutput(QgsProcessingOutputNumber("GIVEN", tr("Photographs given")))

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell what is wrong before anything starts."""
        options_from(self, parameters, context)
        super().check(parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Fill the layers from the run, or from an export in another CRS."""
        run = self.run_folder(parameters, context)
        report = read_report(run / "report.json")
        wanted, photos = self.parameterAsCrs(parameters, CRS, context), photographs_folder(run)
        if not wanted.isValid() or wanted == run_crs(report):
            layers = fill_camera_sinks(self, parameters, context, feedback, run, photos)
        elif report["georeference"] is None:
            raise QgsProcessingException(tr("The run is in map units: georeference it first."))
        else:
            options = options_from(self, parameters, context)
            with tempfile.TemporaryDirectory(prefix="onthefly3r-") as scratch:
                self.export(run, Path(scratch), {**options, "cloud": False}, feedback)
                layers = fill_camera_sinks(self, parameters, context, feedback, Path(scratch), photos)
        return {**layers, "PLACED": report["images"]["placed"], "GIVEN": report["images"]["given"]}
