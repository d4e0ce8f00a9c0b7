"""Load results of a run: its layers from its files, styled and in order."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputHtml,
    QgsProcessingOutputNumber,
)

from .base import tr
from .earlier_run import EarlierRunAlgorithm
from .layers import read_report
from .presentation import load_survey
from .results import run_results, say_results, warnings_of
from .survey import photographs_folder


class LoadResults(EarlierRunAlgorithm):
    """What 'Reconstruct photographs' loads at its end, again."""

    NAME = "loadresults"
    TITLE = "Load results of a run"
    ICON = "cameras.svg"
    needs_environment = False
    HELP = (
        "Adds the layers of an earlier run to the project from the files in its output folder: rejected photographs, "
        "cameras, footprints, orthophoto, point cloud and surface model, as far as they were made, styled, in this "
        "order, and in a group named after the survey. Nothing is computed, and nothing is written."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        self.add_run()
        self.addOutput(QgsProcessingOutputHtml("REPORT", tr("Report")))
        self.addOutput(QgsProcessingOutputNumber("PLACED", tr("Photographs placed")))
        self.addOutput(QgsProcessingOutputNumber("GIVEN", tr("Photographs given")))

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Load the layers and say what the report says."""
        run = self.run_folder(parameters, context)
        results = run_results(run)
        say_results(results, feedback)
        self.warn(warnings_of(read_report(run / "report.json")), feedback)
        load_survey(context, feedback, run, photographs_folder(run))
        return {name: results[name] for name in ("REPORT", "PLACED", "GIVEN")}
