"""Reconstruct many flights: a table or a parent folder in, one row of results per flight out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFeatureSink,
    QgsProcessingParameterFile,
    QgsWkbTypes,
)

from ..core.onthefly3r.protocol import Job
from .base import CoreAlgorithm, tr
from .layers import REAL, TEXT, WHOLE, fill_sink
from .output import OUTPUT, add_output, output_folder
from .parameters import (
    add,
    add_backbone,
    add_further_options,
    add_georeference,
    add_quality,
    options_from,
    require_file,
    require_folder,
)
from .presentation import show
from .reconstruct import require_backbone

FOLDER, TABLE, SKIP_DONE, FLIGHTS = "FOLDER", "TABLE", "SKIP_DONE", "FLIGHTS"

FLIGHT_FIELDS = (
    *((name, TEXT) for name in ("flight", "status", "message", "photos", "out")),
    *((name, WHOLE) for name in ("given", "placed")),
    ("crs", TEXT),
    *((name, REAL) for name in ("rmse_h_m", "rmse_v_m")),
    ("points", REAL),  # more than 2,147,483,647 in large surveys
    *((name, REAL) for name in ("time_s", "memory_mib")),
    ("report", TEXT),
)


class ReconstructFlights(CoreAlgorithm):
    """`onthefly3r batch`."""

    NAME = "reconstructflights"
    TITLE = "Reconstruct many flights"
    ICON = "many.svg"
    STAGES = {}  # noqa: RUF012 - every flight has its share of the bar
    HELP = (
        "Reconstructs one flight after another, for instance over night. A flight that fails is noted with the reason "
        "and does not stop the others; its computation runs apart, so that not even a lack of memory does.\n\nGive "
        "either a parent folder, whose sub-folders are the flights, or a table: a CSV file with the column 'photos' "
        "(folders, relative to the table), and if wanted 'name' (of the flight and its folder of results) and columns "
        "named like the options of the command line, such as crs or working_px, which then hold for that flight.\n\n"
        "Each flight has a folder of its own in the output folder, with the same files as from 'Reconstruct "
        "photographs'; flights.csv beside them lists the results and grows with every flight. A batch that was "
        "cancelled goes on with 'Leave out what is done'."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        behaviour = QgsProcessingParameterFile.Behavior
        add(
            self,
            QgsProcessingParameterFile(FOLDER, tr("Parent folder of the flights"), behaviour.Folder, optional=True),
            tr("Each of its sub-folders that holds photographs is a flight, named like the sub-folder."),
        )
        add(
            self,
            QgsProcessingParameterFile(TABLE, tr("Or a table of flights"), behaviour.File, "csv", optional=True),
            tr("A CSV file in UTF-8, separated by comma, semicolon or tabulator, with the column 'photos'."),
        )
        add_quality(self)
        add_georeference(self)
        add_backbone(self)
        add_further_options(self)
        add(
            self,
            QgsProcessingParameterBoolean(SKIP_DONE, tr("Leave out what is done"), defaultValue=False),
            tr("Flights whose results are in the output folder already are not computed again."),
        )
        add_output(
            self, tr("Holds a folder per flight, and flights.csv. Left empty, a new one beside that of the flights.")
        )
        add(
            self,
            QgsProcessingParameterFeatureSink(
                FLIGHTS, tr("Results of the flights"), QgsProcessing.SourceType.TypeVector, optional=True
            ),
            tr("A table: for each flight its status, the reason of a failure, and the figures of its report."),
        )
        self.addOutput(QgsProcessingOutputFile("FLIGHTS_CSV", tr("Results of the flights as CSV")))
        self.addOutput(QgsProcessingOutputNumber("DONE", tr("Flights that are done")))
        self.addOutput(QgsProcessingOutputNumber("FAILED", tr("Flights that failed")))

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell what is wrong before anything starts."""
        output_folder(self, parameters, context, _named_by(self._flights(parameters, context)))
        options_from(self, parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run all flights and show the table."""
        options = options_from(self, parameters, context)
        if self.parameterAsBoolean(parameters, SKIP_DONE, context):
            options["skip_done"] = True
        flights = self._flights(parameters, context)
        out = output_folder(self, parameters, context, _named_by(flights))
        require_backbone(self, options, feedback)
        feedback.pushInfo(tr("Results go to {}").format(out))
        rows = self.run_core(Job("batch", (str(flights), str(out)), options), feedback)["flights"]
        for row in rows:
            say = feedback.pushWarning if row["status"] == "failed" else feedback.pushInfo
            say(f"{row['flight']}: {row['status']} {row['message']}".rstrip())
        failed = sum(row["status"] == "failed" for row in rows)
        results = {
            OUTPUT: str(out),
            "FLIGHTS_CSV": str(out / "flights.csv"),
            "DONE": len(rows) - failed,
            "FAILED": failed,
        }
        if parameters.get(FLIGHTS) not in (None, ""):
            nowhere, none = QgsCoordinateReferenceSystem(), QgsWkbTypes.Type.NoGeometry
            table = ((row, None) for row in rows)
            results[FLIGHTS] = fill_sink(self, parameters, context, FLIGHTS, FLIGHT_FIELDS, none, nowhere, table)
            show(context, results[FLIGHTS], out.name, "")
        return results

    def _flights(self, parameters: dict[str, Any], context: QgsProcessingContext) -> Path:
        folder = self.parameterAsString(parameters, FOLDER, context)
        table = self.parameterAsString(parameters, TABLE, context)
        if bool(folder) == bool(table):
            raise QgsProcessingException(tr("Give either a parent folder of flights or a table of flights."))
        if folder:
            return require_folder(folder, tr("Parent folder of the flights"))
        return require_file(table, tr("Table of flights"))


def _named_by(flights: Path) -> Path:
    """Return what the folder of results is named after: the parent folder, or the table without its ending."""
    return flights.with_suffix("") if flights.is_file() else flights
