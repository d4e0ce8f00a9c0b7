"""Check photographs before processing: a layer with a verdict for each, footprints, time and memory."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsGeometry,
    QgsPoint,
    QgsPointXY,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterFeatureSink,
    QgsProcessingParameterNumber,
    QgsWkbTypes,
)

from ..core.onthefly3r.protocol import Job
from ..plugin.places import survey_name
from .base import CoreAlgorithm, tr
from .layers import FOOTPRINT_FIELDS, FOOTPRINTS, REAL, TEXT, WHOLE, Row, fill_sink
from .parameters import add, add_georeference, add_quality, options_from
from .presentation import show
from .reconstruct import add_photographs, photographs
from .survey import HEIGHTS

CHECKED, ABOVE_GROUND = "CHECKED", "ABOVE_GROUND_M"

CHECKED_FIELDS = (
    *((name, TEXT) for name in ("image", "verdict", "problems")),
    *((name, REAL) for name in ("height_m", "above_ground_m", "yaw_deg", "pitch_deg", "roll_deg", "gsd_m")),
    ("overlap", WHOLE),
    *((name, REAL) for name in ("best_overlap", "covered", "sharpness", "dark", "bright", "contrast")),
    *((name, WHOLE) for name in ("width_px", "height_px")),
    *((name, TEXT) for name in ("camera", "focal_source", "path")),
)
EXPECTED_FIELDS = tuple(field for field in FOOTPRINT_FIELDS if field[0] != "number")  # a run gives the numbers
NUMBERS = {
    "GIVEN": ("given", "Photographs given"),
    "GOOD": ("good", "Good photographs"),
    "DOUBTFUL": ("doubtful", "Doubtful photographs"),
    "UNUSABLE": ("unusable", "Unusable photographs"),
    "WITH_POSITION": ("with_position", "Photographs with a position"),
    "OVERLAP": ("median_best_overlap", "Overlap with the best neighbour, median share"),
    "COVERED": ("covered", "Share of the ground in at least three photographs"),
    "GSD": ("gsd_m", "Ground sampling distance [m]"),
    "TIME": ("estimated_time_s", "Estimated time of a run [s]"),
    "MEMORY": ("estimated_memory_mib", "Estimated memory of a run [MiB]"),
}


class CheckPhotographs(CoreAlgorithm):
    """`onthefly3r check`."""

    NAME = "check"
    TITLE = "Check photographs before processing"
    ICON = "check.svg"
    STAGES = {}  # noqa: RUF012 - a single stage over the whole bar
    HELP = (
        "Looks at every photograph of a folder without reconstructing anything: is there a position, is it sharp, is "
        "it well exposed, which tags are missing, how much do neighbours overlap. Takes a second for some ten "
        "photographs, so that it can be run in the field, while the flight can still be repeated.\n\nThe layer of "
        "photographs has the verdict good, doubtful (it is used, but may be rejected) or unusable (it cannot be "
        "read), and the problems in words. Overlap follows from positions, angles and flying height on level ground; "
        "where the drone does not state its height above ground, it is measured between photographs. Time and memory "
        "of a run are estimated for this computer and the quality that is chosen, within a factor of two."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        add_photographs(self)
        add_quality(self)
        number = QgsProcessingParameterNumber(
            ABOVE_GROUND, tr("Height above ground [m]"), QgsProcessingParameterNumber.Type.Double, optional=True
        )
        number.setMinimum(0.1)
        number.setDefaultValue(None)
        add(
            self,
            number,
            tr("Flying height. Empty: what the drone states above its take-off, else measured between photographs."),
        )
        add_georeference(self)
        point, polygon = QgsProcessing.SourceType.TypeVectorPoint, QgsProcessing.SourceType.TypeVectorPolygon
        add(
            self,
            QgsProcessingParameterFeatureSink(CHECKED, tr("Checked photographs"), point, optional=True),
            tr("Every photograph with its verdict; those without a position have no geometry."),
        )
        add(
            self,
            QgsProcessingParameterFeatureSink(FOOTPRINTS, tr("Expected footprints"), polygon, optional=True),
            tr("What each photograph should cover on level ground, and how many others cover its middle."),
        )
        for name, (_, title) in NUMBERS.items():
            self.addOutput(QgsProcessingOutputNumber(name, tr(title)))
        self.addOutput(QgsProcessingOutputString("WARNINGS", tr("What to know about the whole flight")))

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell wrong folders before anything starts."""
        photographs(self, parameters, context)
        options_from(self, parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Run the check and show its rows."""
        photos = photographs(self, parameters, context)
        options = options_from(self, parameters, context)
        if parameters.get(ABOVE_GROUND) not in (None, ""):
            options["above_ground_m"] = self.parameterAsDouble(parameters, ABOVE_GROUND, context)
        with tempfile.TemporaryDirectory(prefix="onthefly3r-") as scratch:
            self.run_core(Job("check", (str(photos), scratch), options), feedback)
            checked = json.loads((Path(scratch) / "check.json").read_text(encoding="utf-8"))
        summary, rows = checked["summary"], checked["photographs"]
        self._say(summary, feedback)
        results: dict[str, Any] = {name: summary[key] for name, (key, _) in NUMBERS.items()}
        results["WARNINGS"] = "\n".join(summary["warnings"])
        crs = QgsCoordinateReferenceSystem(summary["crs"] or "")
        sinks = (
            (CHECKED, CHECKED_FIELDS, QgsWkbTypes.Type.PointZ, (point_row(row, photos) for row in rows), "checked.qml"),
            (
                FOOTPRINTS,
                EXPECTED_FIELDS,
                QgsWkbTypes.Type.Polygon,
                (polygon_row(row) for row in rows if row["footprint"]),
                "footprints.qml",
            ),
        )
        for name, fields, geometry, features, style in sinks:
            if parameters.get(name) not in (None, ""):
                results[name] = fill_sink(self, parameters, context, name, fields, geometry, crs, features)
                group = tr("{}, checked").format(survey_name(photos))
                show(context, results[name], group, style, HEIGHTS.get(name.lower(), HEIGHTS["cameras"]))
        return results

    def _say(self, summary: dict[str, Any], feedback: QgsProcessingFeedback) -> None:
        feedback.pushInfo(
            tr("{given} photographs: {good} good, {doubtful} doubtful, {unusable} unusable.").format(**summary)
        )
        if summary["estimated_time_s"] is not None:
            minutes, memory_gib = summary["estimated_time_s"] / 60.0, summary["estimated_memory_mib"] / 1024.0
            feedback.pushInfo(
                tr("A run takes about {:.1f} minutes and {:.1f} GiB of memory.").format(minutes, memory_gib)
            )


def point_row(row: dict[str, Any], photos: Path) -> Row:
    """Return the attributes and the place of a checked photograph."""
    place = None if row["x"] is None else QgsGeometry(QgsPoint(row["x"], row["y"], row["height_m"] or 0.0))
    return {**row, "problems": "; ".join(row["problems"]), "path": str(photos.absolute() / row["image"])}, place


def polygon_row(row: dict[str, Any]) -> Row:
    """Return the attributes and the outline of what a photograph should cover."""
    outline = QgsGeometry.fromPolygonXY([[QgsPointXY(x, y) for x, y in row["footprint"]]])
    values = {"image": row["image"], "gsd_m": row["gsd_m"], "area_m2": outline.area(), "overlap": row["overlap"]}
    return values, outline
