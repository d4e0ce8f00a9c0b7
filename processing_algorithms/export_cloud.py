"""Export georeferenced point cloud: the points of an earlier run in another format, CRS, spacing or extent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import qgis.core
from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterFileDestination,
)

from ..core.onthefly3r.files.atomic import replace_file
from ..core.onthefly3r.files.las_index import indexes_beside, indexes_of
from .base import tr
from .boundary import add_boundary, area_of, boundary_file
from .earlier_run import EarlierRunAlgorithm, scratch_folder
from .parameters import add, add_options, add_target_crs, options_from
from .presentation import show
from .survey import HEIGHTS, photographs_folder, survey_title

OUTPUT = "OUTPUT"
FORMATS = ("laz", "las", "copc.laz")


def cloud_destination(name: str, title: str) -> Any:
    """Return the destination of a point cloud; a plain file before QGIS 3.24, which has no parameter for clouds."""
    kind = getattr(qgis.core, "QgsProcessingParameterPointCloudDestination", None)
    if kind is not None:
        return kind(name, title)
    return QgsProcessingParameterFileDestination(name, title, "LAZ (*.laz);;LAS (*.las)")


class ExportCloud(EarlierRunAlgorithm):
    """`onthefly3r export`, of which only the cloud is kept."""

    NAME = "exportcloud"
    TITLE = "Export georeferenced point cloud"
    ICON = "cloud.svg"
    HELP = (
        "Writes the point cloud of an earlier run again: as LAS or LAZ, in another projected coordinate reference "
        "system, coarser or finer, only its surer points, or cut to an area. What is left empty stays as it was in "
        "that run. Takes seconds to minutes, because nothing is reconstructed again."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        self.add_run()
        add_target_crs(self, again=True)
        add_options(self, "spacing_m", "min_confidence", "stray_filter")
        add_boundary(self)
        add(
            self,
            cloud_destination(OUTPUT, tr("Point cloud")),
            tr("A file ending in .laz, .copc.laz or .las: LAS 1.4 with colour, confidence and source photograph."),
        )
        self.addOutput(QgsProcessingOutputNumber("POINTS", tr("Points")))
        self.addOutput(QgsProcessingOutputNumber("SPACING", tr("Mean distance of points [m]")))
        self.addOutput(QgsProcessingOutputString("CRS_OUT", tr("Coordinate reference system of the cloud")))

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell wrong endings before anything starts."""
        super().check(parameters, context)
        options_from(self, parameters, context)
        area_of(self, parameters, context)
        path = self.parameterAsFileOutput(parameters, OUTPUT, context)
        if _format(path) not in FORMATS:
            raise QgsProcessingException(tr("{} ends neither in .laz, .copc.laz nor in .las.").format(path))

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Export into a scratch folder and keep the cloud."""
        run = self.run_folder(parameters, context)
        out = self._destination(parameters, context)
        options = {**options_from(self, parameters, context, every=True), "format": _format(str(out)).partition(".")[0]}
        with scratch_folder(out) as scratch, boundary_file(self, parameters, context) as boundary:
            self.export(run, scratch, {**options, "boundary": boundary}, feedback)
            report = json.loads((scratch / "report.json").read_text(encoding="utf-8"))
            if report["georeference"] is None:
                feedback.pushWarning(tr("The run is not georeferenced: the cloud is in map units."))
            stale = indexes_of(out)
            try:
                replace_file(scratch / f"cloud.{_format(str(out))}", out)
            except OSError as error:
                raise QgsProcessingException(tr("{} cannot be written ({}).").format(out, error.strerror)) from error
            for index in stale:  # of the cloud that was replaced: QGIS would show it instead of the new one
                index.remove()
            for foreign in indexes_beside(out):
                feedback.pushWarning(
                    tr("{} is not of this cloud: QGIS may show it instead; move it away.").format(foreign.path)
                )
        show(context, str(out), survey_title(run, photographs_folder(run)), "cloud", HEIGHTS["cloud"])
        cloud, geo = report["cloud"], report["georeference"] or {}
        return {
            OUTPUT: str(out),
            "POINTS": cloud["points"],
            "SPACING": cloud["mean_spacing_m"],
            "CRS_OUT": geo.get("crs", ""),
        }

    def _destination(self, parameters: dict[str, Any], context: QgsProcessingContext) -> Path:
        """Return the file, and have QGIS load it where it is a layer to QGIS."""
        if isinstance(self.parameterDefinition(OUTPUT), QgsProcessingParameterFileDestination):
            return Path(self.parameterAsFileOutput(parameters, OUTPUT, context))
        return Path(self.parameterAsOutputLayer(parameters, OUTPUT, context))


def _format(path: str) -> str:
    """Return the ending of a cloud's name, which is that of the core's own file too."""
    name = Path(path).name.lower()
    return "copc.laz" if name.endswith(".copc.laz") else Path(name).suffix.lstrip(".")
