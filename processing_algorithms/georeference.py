"""Georeference reconstruction: another CRS, height reference or position file for an earlier run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
)

from .base import tr
from .earlier_run import EarlierRunAlgorithm
from .output import OUTPUT, add_output, output_folder
from .parameters import add_control, add_georeference, add_options, options_from
from .results import add_run_outputs, hand_over
from .survey import photographs_folder

GEOREFERENCED = "georeferenced"


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
        add_control(self)
        add_options(self, "gps_sigma_h_m", "gps_sigma_v_m", "local", "format")
        add_output(
            self,
            tr(
                "Another folder than that of the run; left empty, a new one beside it. It holds no map: use the first "
                "run's folder to georeference it again."
            ),
        )
        add_run_outputs(self)

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell what is wrong before anything starts."""
        options_from(self, parameters, context)
        run = self.run_folder(parameters, context)
        named = self.parameterAsString(parameters, OUTPUT, context).strip()
        if named and Path(named).resolve() == run.resolve():
            raise QgsProcessingException(tr("The output folder is that of the run: name another one."))
        output_folder(self, parameters, context, run, GEOREFERENCED)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Write everything again, then fill the layers."""
        run = self.run_folder(parameters, context)
        out = output_folder(self, parameters, context, run, GEOREFERENCED)
        options = options_from(self, parameters, context, every=True)
        self.export(run, out, options, feedback)
        return {OUTPUT: str(out), **hand_over(self, parameters, context, feedback, out, photographs_folder(run))}
