"""Reconstruct photographs: a folder in, cloud, cameras, footprints and report out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
)

from ..core.onthefly3r.protocol import Job
from ..plugin import settings
from ..plugin.worker import describe_backbones
from .base import CoreAlgorithm, tr
from .boundary import add_boundary, area_of, boundary_file
from .output import OUTPUT, add_output, output_folder
from .parameters import (
    add,
    add_backbone,
    add_control,
    add_further_options,
    add_georeference,
    add_quality,
    options_from,
    require_folder,
)
from .results import add_run_outputs, hand_over
from .survey import shows_copc

PHOTOS = "PHOTOS"


def add_photographs(algorithm: CoreAlgorithm) -> None:
    """Add the folder of photographs."""
    add(
        algorithm,
        QgsProcessingParameterFile(PHOTOS, tr("Folder of photographs"), QgsProcessingParameterFile.Behavior.Folder),
        tr("JPEG, PNG or TIFF as they come from the drone; sub-folders are searched. Nothing is written there."),
    )


def photographs(algorithm: CoreAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext) -> Path:
    """Return the folder of photographs; raises `QgsProcessingException` when it is none."""
    given = algorithm.parameterAsString(parameters, PHOTOS, context)
    return require_folder(given.strip(), tr("Folder of photographs"))


def require_backbone(algorithm: CoreAlgorithm, options: dict[str, Any], feedback: QgsProcessingFeedback) -> None:
    """Raise `QgsProcessingException` with what to do where the backbone that was chosen cannot run here."""
    name = options.get("backbone", "classical")
    if name == "classical":
        return
    described = describe_backbones(settings.interpreter(), feedback.isCanceled, settings.worker_variables())
    found = next((item for item in described if item["name"] == name), None)
    if found is None and described:
        known = ", ".join(item["name"] for item in described)
        raise QgsProcessingException(tr("There is no backbone {}: choose one of {}.").format(name, known))
    if found is not None and not found["installed"]:
        raise QgsProcessingException(tr("The backbone {} is not installed: {}").format(name, found["next_step"]))
    if found is not None and found["weights"] == "" and "weights" not in options:
        raise QgsProcessingException(tr("The weights of {} are missing: {}").format(name, found["next_step"]))


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
        "All files are in the output folder, and report.html there tells how good they are; the other algorithms of "
        "this group take that folder.\n\nAbsolute accuracy is that of the drone's receiver, metres without RTK, "
        "unless there is ground control.\n\nNo flight at hand? 'Try with a sample flight' makes one."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        add_photographs(self)
        add_quality(self)
        add_georeference(self)
        add_boundary(self)
        add_control(self)
        add_backbone(self)
        add_further_options(self)
        add_output(
            self,
            tr(
                "New, empty, or of an earlier run, whose files are replaced. Left empty, a new one beside the "
                "photographs, or in the folder of the project where nothing can be written there. About 5 MB per "
                "photograph while computing."
            ),
        )
        add_run_outputs(self)

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell wrong folders before anything starts."""
        photos = photographs(self, parameters, context)
        options_from(self, parameters, context)
        output_folder(self, parameters, context, photos)
        area_of(self, parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the job, then fill the layers."""
        photos = photographs(self, parameters, context)
        run = output_folder(self, parameters, context, photos)
        options = options_from(self, parameters, context)
        if "format" not in options and shows_copc():  # the one that QGIS shows at once
            options["format"] = "copc"
        require_backbone(self, options, feedback)
        feedback.pushInfo(tr("Results go to {}").format(run))
        with boundary_file(self, parameters, context) as boundary:
            self.run_core(Job("run", (str(photos), str(run)), {**options, "boundary": boundary}), feedback)
        return {OUTPUT: str(run), **hand_over(self, parameters, context, feedback, run, photos)}
