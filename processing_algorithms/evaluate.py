"""Evaluate against a reference: the paper's metrics of poses and clouds as numbers and a table."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputNumber,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFeatureSink,
    QgsProcessingParameterFile,
    QgsWkbTypes,
)

from ..core.onthefly3r.protocol import Job
from .base import chosen_word, tr
from .earlier_run import EarlierRunAlgorithm
from .layers import REAL, TEXT, fill_sink
from .parameters import add, require_file, require_folder, words_parameter
from .presentation import show

POSES, POSES_FOLDER, CLOUD, ALIGN, CLOUD_ALIGN, ICP, TABLE = (
    "REFERENCE_POSES",
    "REFERENCE_FOLDER",
    "REFERENCE_CLOUD",
    "ALIGN",
    "CLOUD_ALIGN",
    "ICP",
    "TABLE",
)
TABLE_FIELDS = (("group", TEXT), ("metric", TEXT), ("value", REAL), ("unit", TEXT), ("meaning", TEXT))

# output -> (part of the report, its name there, metric, unit, meaning)
METRICS: dict[str, tuple[str, str, str, str, str]] = {
    "ATE": ("poses", "ate", "ATE", "m", "camera positions after the fit, RMS, in the unit of the reference"),
    "ATE_PERCENT": ("poses", "ate_percent_of_depth", "ATE", "%", "the same in per cent of the flying height"),
    "ARE": ("poses", "are_deg", "ARE", "deg", "camera attitudes after the fit, RMS"),
    "RTE": ("poses", "rte_deg", "RTE", "deg", "directions from one image to the next, RMS"),
    "RRE": ("poses", "rre_deg", "RRE", "deg", "rotations from one image to the next, RMS"),
    "COVERAGE": ("poses", "coverage", "coverage", "", "share of the reference's images that are placed"),
    "COMMON": ("poses", "n_common", "images", "", "images that were compared"),
    "ACCURACY": ("cloud", "accuracy_m", "Acc.", "m", "mean distance of the points from the reference"),
    "COMPLETENESS": (
        "cloud",
        "completeness_m",
        "Comp.",
        "m",
        "mean distance of the reference from the points",
    ),
    "CHAMFER": ("cloud", "chamfer_m", "CD", "m", "Chamfer distance, the mean of both"),
}


class Evaluate(EarlierRunAlgorithm):
    """`onthefly3r evaluate`."""

    NAME = "evaluate"
    TITLE = "Evaluate against a reference"
    ICON = "evaluate.svg"
    STAGES = {}  # noqa: RUF012 - tells no progress
    HELP = (
        "Says how far the cameras and the cloud of a run are from a reference, in the measures of the literature. "
        "Cameras: ATE (position), ARE (attitude), RTE and RRE (from image to image), coverage. Cloud: accuracy, "
        "completeness and Chamfer distance.\n\nReference cameras may be a COLMAP text model (images.txt, or its "
        "folder), a table like our trajectory.csv, a TUM trajectory, or the folder of another run; images are "
        "matched by name. A reference cloud is a LAS, LAZ or PLY file in the same coordinate reference system."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        behaviour = QgsProcessingParameterFile.Behavior
        self.add_run()
        add(
            self,
            QgsProcessingParameterFile(POSES, tr("Reference cameras, file"), behaviour.File, optional=True),
            tr("images.txt of a COLMAP text model, a table with image, x, y, z, omega, phi, kappa, or a TUM file."),
        )
        add(
            self,
            QgsProcessingParameterFile(POSES_FOLDER, tr("Reference cameras, folder"), behaviour.Folder, optional=True),
            tr("Instead of a file: the folder of a COLMAP text model or of another run."),
        )
        add(
            self,
            QgsProcessingParameterFile(CLOUD, tr("Reference cloud"), behaviour.File, optional=True),
            tr("LAS, LAZ or PLY, for instance from laser scanning."),
        )
        add(
            self,
            words_parameter(ALIGN, tr("Fit before cameras are compared"), ("sim3", "se3", "none"), "sim3"),
            tr("sim3: shift, turn and scale. se3: without scale. none: as they lie, for absolute accuracy."),
        )
        add(
            self,
            words_parameter(CLOUD_ALIGN, tr("Fit before clouds are compared"), ("none", "poses"), "none"),
            tr("none: as they lie. poses: moved like the cameras were fitted."),
        )
        add(
            self,
            QgsProcessingParameterBoolean(ICP, tr("Refine the fit of the clouds (ICP)"), defaultValue=False),
            tr("Needs the package open3d in the environment."),
            advanced=True,
        )
        add(
            self,
            QgsProcessingParameterFeatureSink(
                TABLE, tr("Evaluation"), QgsProcessing.SourceType.TypeVector, optional=True
            ),
            tr("A table with a row per measure, its unit and its meaning."),
        )
        for name, (_, _, metric, unit, meaning) in METRICS.items():
            self.addOutput(QgsProcessingOutputNumber(name, f"{metric} [{unit or 1}]: {tr(meaning)}"))

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell what is missing before anything starts."""
        super().check(parameters, context)
        self._references(parameters, context)

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Compare, then fill the table."""
        run = self.run_folder(parameters, context)
        options = {
            **self._references(parameters, context),
            "align": chosen_word(self, parameters, context, ALIGN),
            "cloud_align": chosen_word(self, parameters, context, CLOUD_ALIGN),
        }
        if self.parameterAsBoolean(parameters, ICP, context):
            options["icp"] = True
        report = self.run_core(Job("evaluate", (str(run),), options), feedback)
        results: dict[str, Any] = {
            name: (report[part] or {}).get(key) for name, (part, key, _, _, _) in METRICS.items()
        }
        rows = [
            {"group": part, "metric": metric, "value": results[name], "unit": unit, "meaning": tr(meaning)}
            for name, (part, _, metric, unit, meaning) in METRICS.items()
            if results[name] is not None
        ]
        for row in rows:
            feedback.pushInfo(f"{row['metric']:<9} {row['value']:.5g} {row['unit']}  {row['meaning']}")
        if parameters.get(TABLE) not in (None, ""):
            nowhere, none = QgsCoordinateReferenceSystem(), QgsWkbTypes.Type.NoGeometry
            features = ((row, None) for row in rows)
            results[TABLE] = fill_sink(self, parameters, context, TABLE, TABLE_FIELDS, none, nowhere, features)
            show(context, results[TABLE], run.name, "")
        return results

    def _references(self, parameters: dict[str, Any], context: QgsProcessingContext) -> dict[str, str]:
        """Return the options that name the references; raises `QgsProcessingException` when there are none."""
        file, folder, cloud = (
            self.parameterAsString(parameters, name, context) for name in (POSES, POSES_FOLDER, CLOUD)
        )
        if file and folder:
            raise QgsProcessingException(tr("Give the reference cameras as a file or as a folder, not both."))
        if not (file or folder or cloud):
            raise QgsProcessingException(tr("Give reference cameras, a reference cloud, or both."))
        named = {"reference_poses": file or folder, "reference_cloud": cloud}
        for given, title, require in (
            (file, tr("Reference cameras, file"), require_file),
            (folder, tr("Reference cameras, folder"), require_folder),
            (cloud, tr("Reference cloud"), require_file),
        ):
            if given:
                require(given, title)
        return {name: path for name, path in named.items() if path}
