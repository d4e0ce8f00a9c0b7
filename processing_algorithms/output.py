"""The output folder as a parameter: where it is when nobody says, and what it must not be."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingOutputFolder,
    QgsProcessingParameterFile,
    QgsProcessingUtils,
    QgsProject,
)
from qgis.PyQt.QtCore import QStandardPaths

from ..plugin.places import LITTER, RESULTS, default_output, is_free
from .base import CoreAlgorithm, tr
from .parameters import add

OUTPUT = "OUTPUT"
STAMP = "onthefly3r.json"  # that the core leaves in a folder of its own


def add_output(algorithm: CoreAlgorithm, help: str) -> None:
    """Add the output folder, which may be left empty."""
    folder = QgsProcessingParameterFile.Behavior.Folder
    add(algorithm, QgsProcessingParameterFile(OUTPUT, tr("Output folder"), folder, optional=True), help)
    algorithm.addOutput(QgsProcessingOutputFolder(OUTPUT, tr("Output folder")))


def output_folder(
    algorithm: CoreAlgorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    photos: Path,
    what: str = RESULTS,
) -> Path:
    """Return the folder for the results of these photographs; raises `QgsProcessingException` for one that is taken.

    `what` ends the name of a folder that nobody named.
    """
    named = algorithm.parameterAsString(parameters, OUTPUT, context).strip()
    if not named:
        home = (context.project() or QgsProject.instance()).homePath()
        return default_output(photos, Path(home) if home else None, documents_folder(), what=what)
    if named == QgsProcessing.TEMPORARY_OUTPUT:
        return Path(QgsProcessingUtils.generateTempFilename("reconstructed"))
    return require_output(Path(named).absolute(), photos)


def require_output(out: Path, photos: Path | None = None) -> Path:
    """Return a folder that results may go into; raises `QgsProcessingException` with the cause where they may not."""
    if photos is not None and out == photos.absolute():
        raise QgsProcessingException(tr("The output folder is that of the photographs: name another one."))
    if out.exists() and not out.is_dir():
        raise QgsProcessingException(tr("The output folder {} is a file: name a folder.").format(out))
    if not is_free(out) and not (out / STAMP).is_file() and os.access(out, os.R_OK):
        other = min(inner.name for inner in out.iterdir() if inner.name not in LITTER)
        raise QgsProcessingException(
            tr("The output folder {} holds {}, which is of no earlier run: name a new or empty folder.").format(
                out, other
            )
        )
    existing = next(place for place in (out, *out.parents) if place.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise QgsProcessingException(tr("Nothing can be written into {}: name another folder.").format(existing))
    return out


def documents_folder() -> Path:
    """Return the user's folder of documents."""
    return Path(QStandardPaths.writableLocation(QStandardPaths.StandardLocation.DocumentsLocation) or Path.home())
