"""The folder of an earlier run as a parameter, shared by the algorithms that work on one."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
)

from ..core.onthefly3r.protocol import Job
from .base import EXPORT_STAGES, CoreAlgorithm, tr
from .parameters import add, require_folder

RUN = "RUN"


class EarlierRunAlgorithm(CoreAlgorithm):
    """An algorithm over the output folder of a run; nothing is reconstructed again."""

    STAGES = EXPORT_STAGES

    def add_run(self) -> None:
        """Add the folder of the run."""
        add(
            self,
            QgsProcessingParameterFile(RUN, tr("Folder of a run"), QgsProcessingParameterFile.Behavior.Folder),
            tr("The output folder of 'Reconstruct photographs', with its sub-folder 'work'. It is only read."),
        )

    def run_folder(self, parameters: dict[str, Any], context: QgsProcessingContext) -> Path:
        """Return the folder; raises `QgsProcessingException` when it holds no run."""
        run = require_folder(self.parameterAsString(parameters, RUN, context), tr("Folder of a run"))
        if not (run / "report.json").is_file() and not (run / "work" / "run.json").is_file():
            raise QgsProcessingException(
                tr("{} holds no report.json: name the output folder of 'Reconstruct photographs'.").format(run)
            )
        return run

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Tell wrong folders before anything starts."""
        self.run_folder(parameters, context)

    def export(self, run: Path, out: Path, options: dict[str, Any], feedback: QgsProcessingFeedback) -> dict[str, Any]:
        """Write the files of the run again into `out`, with options that replace those of the run."""
        return self.run_core(Job("export", (str(run), str(out)), options), feedback)


@contextlib.contextmanager
def scratch_folder(beside: Path) -> Iterator[Path]:
    """Yield a folder on the disk of `beside`, so that what is written there can be renamed; removed at the end."""
    beside.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".onthefly3r-", dir=beside.parent) as folder:
        yield Path(folder)
