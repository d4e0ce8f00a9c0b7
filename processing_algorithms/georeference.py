"""Georeference reconstruction: another CRS, height reference or position file for an earlier run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFolderDestination,
)

from .base import tr
from .earlier_run import EarlierRunAlgorithm
from .parameters import add, add_georeference, add_options, options_from
from .results import add_run_outputs, hand_over

OUTPUT = "OUTPUT"


class Georeference(EarlierRunAlgorithm):
    """`onthefly3r export` with other options of georeferencing."""

    NAME = "georeference"
    TITLE = "Georeference reconstruction"
    ICON = "georeference.svg"
    HELP = (
        "Ties an earlier run to the Earth again, without reconstructing: in another coordinate reference system, with "
        "another reference of the heights, or with positions from a file, for instance from a post-processed flight "
        "log (PPK). All files of a run are written into a new folder. What is left as it is stays as in that run."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        self.add_run()
        add_georeference(self, again=True)
        add_options(self, "gps_sigma_h_m", "gps_sigma_v_m", "local", "format")
        add(
            self,
            QgsProcessingParameterFolderDestination(OUTPUT, tr("Output folder")),
            tr("Another folder than that of the run. It holds no map: use the first run's folder to georeference it."),
        )
        add_run_outputs(self)

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell what is wrong before anything starts."""
        options_from(self, parameters, context)
        run = self.run_folder(parameters, context)
        if Path(self.parameterAsString(parameters, OUTPUT, context)).resolve() == run.resolve():
            raise QgsProcessingException(tr("The output folder is that of the run: name another one."))

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Write everything again, then fill the layers."""
        out = Path(self.parameterAsString(parameters, OUTPUT, context))
        options = options_from(self, parameters, context, every=True)
        self.export(self.run_folder(parameters, context), out, options, feedback)
        return {OUTPUT: str(out), **hand_over(self, parameters, context, feedback, out)}
