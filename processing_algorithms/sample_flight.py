"""Try with a sample flight: photographs are simulated, reconstructed, and compared with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFolder,
    QgsProcessingOutputNumber,
)

from ..core.onthefly3r.protocol import Job
from ..plugin.places import unused
from .base import RUN_STAGES, CoreAlgorithm, Stages, tr
from .output import OUTPUT, add_output, documents_folder, require_output
from .results import add_run_outputs, hand_over

NAME = "Sample flight"
RENDERED_AT = 20  # per cent
STAGES: Stages = {
    "simulate": (0, RENDERED_AT),
    **{
        name: (RENDERED_AT + round(0.8 * begin), RENDERED_AT + round(0.8 * end))
        for name, (begin, end) in RUN_STAGES.items()
    },
}


class SampleFlight(CoreAlgorithm):
    """`onthefly3r demo`."""

    NAME = "sampleflight"
    TITLE = "Try with a sample flight"
    ICON = "reconstruct.svg"
    STAGES = STAGES
    HELP = (
        "Makes up a small flight over a village, with positions in the tags of its photographs, reconstructs it from "
        "the photographs alone, and loads the results: what your own flight will look like. Takes a few minutes and "
        "needs no download. Because the truth is known, the log says how far the cameras and the cloud are from "
        "it.\n\nThe photographs are in the sub-folder 'photos' of the output folder: try the other algorithms with "
        "them too."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        add_output(self, tr("New or empty. Left empty, a new one in On-the-Fly3R in your documents."))
        add_run_outputs(self)
        self.addOutput(QgsProcessingOutputFolder("PHOTOS", tr("Folder of the simulated photographs")))
        self.addOutput(QgsProcessingOutputNumber("CAMERA_ERROR", tr("Distance of the cameras from the truth, RMS [m]")))
        self.addOutput(QgsProcessingOutputNumber("CLOUD_ERROR", tr("Distance of the cloud from the truth, mean [m]")))

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell what is wrong before anything starts."""
        self._folder(parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Simulate and reconstruct, then fill the layers."""
        out = self._folder(parameters, context)
        feedback.pushInfo(tr("The flight and its results go to {}").format(out))
        accuracy = self.run_core(Job("demo", (str(out),)), feedback)["accuracy"]
        feedback.pushInfo(
            tr("Against the truth: cameras {ate_m:.3f} m, cloud {cloud_fitted_m:.3f} m.").format(**accuracy)
        )
        return {
            OUTPUT: str(out),
            "PHOTOS": str(out / "photos"),
            "CAMERA_ERROR": accuracy["ate_m"],
            "CLOUD_ERROR": accuracy["cloud_fitted_m"],
            **hand_over(self, parameters, context, feedback, out / "result", out / "photos"),
        }

    def _folder(self, parameters: dict[str, Any], context: QgsProcessingContext) -> Path:
        named = self.parameterAsString(parameters, OUTPUT, context).strip()
        if not named:
            return unused(documents_folder() / "On-the-Fly3R", NAME)
        return require_output(Path(named).absolute())
