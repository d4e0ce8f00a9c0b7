"""Reconstruct photographs: a folder in, cloud, cameras, footprints and report out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
)

from ..core.onthefly3r.protocol import Job
from .base import CoreAlgorithm, tr
from .boundary import add_boundary, boundary_file
from .parameters import (
    add,
    add_all_options,
    add_backbone,
    add_georeference,
    add_quality,
    options_from,
    require_folder,
)
from .results import add_run_outputs, hand_over

PHOTOS, OUTPUT = "PHOTOS", "OUTPUT"


def add_photographs(algorithm: CoreAlgorithm) -> None:
    """Add the folder of photographs."""
    add(
        algorithm,
        QgsProcessingParameterFile(PHOTOS, tr("Folder of photographs"), QgsProcessingParameterFile.Behavior.Folder),
        tr("JPEG, PNG or TIFF as they come from the drone; sub-folders are searched. Nothing is written there."),
    )


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
        add_photographs(self)
        add_quality(self)
        add_georeference(self)
        add_boundary(self)
        add_backbone(self)
        add_all_options(self)
        add(
            self,
            QgsProcessingParameterFolderDestination(OUTPUT, tr("Output folder")),
            tr("Empty or of an earlier run, whose files are replaced. About 5 MB per photograph while computing."),
        )
        add_run_outputs(self)

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell wrong folders before anything starts."""
        require_folder(self.parameterAsString(parameters, PHOTOS, context), tr("Folder of photographs"))
        options_from(self, parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the job, then fill the layers."""
        photos = require_folder(self.parameterAsString(parameters, PHOTOS, context), tr("Folder of photographs"))
        run = Path(self.parameterAsString(parameters, OUTPUT, context))
        options = options_from(self, parameters, context)
        with boundary_file(self, parameters, context) as boundary:
            self.run_core(Job("run", (str(photos), str(run)), {**options, "boundary": boundary}), feedback)
        return {OUTPUT: str(run), **hand_over(self, parameters, context, feedback, run)}
