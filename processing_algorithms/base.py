"""What the algorithms share: names, help, the worker, and results of a run as layers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
)
from qgis.PyQt.QtCore import QCoreApplication
from qgis.PyQt.QtGui import QIcon

from ..core.onthefly3r.protocol import Event, Job
from ..plugin import settings
from ..plugin.explain import NO_INTERPRETER
from ..plugin.worker import WorkerCancelled, WorkerError, run_job

ROOT = Path(__file__).resolve().parents[1]
ICONS = ROOT / "resources" / "icons"

Stages = Mapping[str, tuple[int, int]]

# Where each stage of a run begins and ends on the bar, in per cent; measured on surveys of 20 to 170 photographs.
RUN_STAGES: Stages = {
    "reading photographs": (0, 20),
    "starting the map": (20, 27),
    "reconstructing": (27, 77),
    "refining the cameras": (77, 84),
    "georeferencing": (84, 85),
    "collecting points": (85, 90),
    "fusing the cloud": (90, 99),
}
EXPORT_STAGES: Stages = {"collecting points": (0, 50), "fusing the cloud": (50, 99)}


def tr(text: str) -> str:
    """Return the text in the user's language."""
    return QCoreApplication.translate("OnTheFly3R", text)


class FeedbackListener:
    """Passes what the worker tells to a Processing feedback."""

    def __init__(self, feedback: QgsProcessingFeedback, stages: Stages) -> None:
        self._feedback = feedback
        self._stages = stages
        self._stage = ""

    def is_cancelled(self) -> bool:
        """Return whether the user cancelled."""
        return self._feedback.isCanceled()

    def event(self, event: Event) -> None:
        """Show a progress report or a warning."""
        if event.kind == "warning":
            self._feedback.pushWarning(str(event.data.get("message", "")))
        elif event.kind == "progress":
            self._progress(event.data)

    def line(self, text: str) -> None:
        """Show a line that is no event."""
        self._feedback.pushConsoleInfo(text)

    def _progress(self, data: dict[str, Any]) -> None:
        stage, done, total = str(data.get("stage", "")), data.get("done", 0), data.get("total", 0)
        begin, end = self._stages.get(stage, (0, 100))
        if total:
            self._feedback.setProgress(begin + (end - begin) * min(1.0, done / total))
        counts = [(data.get("placed"), tr("placed")), (data.get("rejected"), tr("rejected"))]
        counts_text = ", ".join(f"{count} {word}" for count, word in counts if count)
        text = f"{stage}: {data['message']}" if data.get("message") else f"{stage} {done}/{total}"
        self._feedback.setProgressText(text + (f" ({counts_text})" if counts_text else ""))
        if stage != self._stage:
            self._stage = stage
            self._feedback.pushInfo(stage)


class CoreAlgorithm(QgsProcessingAlgorithm):
    """An algorithm that runs a job of the core; subclasses set the class attributes."""

    NAME = ""
    TITLE = ""  # in English, translated where it is shown
    HELP = ""
    ICON = "onthefly3r.svg"
    STAGES: Stages = RUN_STAGES
    needs_environment = True

    def createInstance(self) -> CoreAlgorithm:
        """Return a fresh instance."""
        return type(self)()

    def name(self) -> str:
        """Return the name within the provider."""
        return self.NAME

    def displayName(self) -> str:
        """Return the title in the toolbox."""
        return tr(self.TITLE)

    def shortHelpString(self) -> str:
        """Return what the algorithm does."""
        return tr(self.HELP)

    def shortDescription(self) -> str:
        """Return the first sentence of the help, for tool tips."""
        return tr(self.HELP).split(".")[0].strip() + "."

    def icon(self) -> QIcon:
        """Return the icon."""
        return QIcon(str(ICONS / self.ICON))

    def svgIconPath(self) -> str:
        """Return the icon's file."""
        return str(ICONS / self.ICON)

    def helpUrl(self) -> str:
        """Return the page of the documentation that travels with the plugin."""
        return (ROOT / "docs" / "qgis.md").as_uri()

    def canExecute(self) -> tuple[bool, str]:
        """Return whether there is an interpreter for the core, and what to do when there is none."""
        if self.needs_environment and not settings.interpreter():
            return False, tr(NO_INTERPRETER)
        return True, ""

    def check(self, parameters: dict[str, Any], context: QgsProcessingContext) -> None:
        """Raise `QgsProcessingException` with what is wrong about the parameters; called before anything starts."""

    def checkParameterValues(self, parameters: dict[str, Any], context: QgsProcessingContext) -> tuple[bool, str]:
        """Return whether the parameters will do, and what is wrong with them."""
        try:
            self.check(parameters, context)
        except QgsProcessingException as error:
            return False, str(error)
        return super().checkParameterValues(parameters, context)

    def run_core(self, job: Job, feedback: QgsProcessingFeedback) -> dict[str, Any]:
        """Run a job and return the data of its result; raises `QgsProcessingException` with the remedy."""
        try:
            return run_job(settings.interpreter(), job, FeedbackListener(feedback, self.STAGES))
        except WorkerCancelled:
            raise QgsProcessingException(tr("Cancelled: the worker and all that it started have ended.")) from None
        except WorkerError as error:
            if error.diagnostics:
                settings.save_diagnostics(error.diagnostics)
                feedback.pushConsoleInfo(error.diagnostics)
            raise QgsProcessingException(str(error)) from None
