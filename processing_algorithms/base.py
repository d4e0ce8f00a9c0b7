"""What the algorithms share: names, help, the worker, and results of a run as layers."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterEnum,
)
from qgis.PyQt.QtCore import QCoreApplication
from qgis.PyQt.QtGui import QIcon

from ..core.onthefly3r.protocol import Event, Job
from ..plugin import settings
from ..plugin.explain import NO_INTERPRETER
from ..plugin.help_page import help_page
from ..plugin.timeleft import TimeLeft
from ..plugin.worker import WorkerCancelled, WorkerError, run_job

ROOT = Path(__file__).resolve().parents[1]
ICONS = ROOT / "resources" / "icons"

Stages = Mapping[str, tuple[int, int]]

# Where each stage of a run begins and ends on the bar, in per cent: about its share of the time.
RUN_STAGES: Stages = {
    "reading photographs": (0, 12),
    "starting the map": (12, 18),
    "reconstructing": (18, 50),
    "starting another part of the map": (18, 50),
    "joining parts of the map": (18, 50),
    "refining the cameras": (50, 54),
    "georeferencing": (54, 55),
    "collecting points": (55, 66),
    "reading photographs again": (55, 58),
    "matching depths": (58, 66),
    "comparing depths": (66, 70),
    "aligning depths": (70, 71),
    "averaging depths": (71, 74),
    "making points": (74, 78),
    "fusing the cloud": (78, 82),
    "writing the cloud": (82, 86),
    "comparing colours": (86, 88),
    "orthophoto": (88, 99),
}
# What people look for who do not know the name.
TAGS = (
    "uav", "drone", "uas", "rpas", "aerial", "photogrammetry", "sfm", "structure from motion", "mvs", "odm", "lidar",
    "las", "laz", "copc", "point cloud", "orthophoto", "orthomosaic", "dem", "dsm", "dtm", "camera", "gps", "rtk",
    "ground control", "gcp", "colmap", "photographs", "images", "3d",
)  # fmt: skip
EXPORT_STAGES: Stages = {  # the same from the georeferencing on, over the whole bar
    name: (round((begin - 54) * 2.2), round((end - 54) * 2.2))
    for name, (begin, end) in RUN_STAGES.items()
    if begin >= 54
}


def tr(text: str) -> str:
    """Return the text in the user's language."""
    return QCoreApplication.translate("OnTheFly3R", text)


class FeedbackListener:
    """Passes what the worker tells to a Processing feedback."""

    def __init__(self, feedback: QgsProcessingFeedback, stages: Stages) -> None:
        self._feedback = feedback
        self._stages = stages
        self._stage = ""
        self._percent = 0.0
        self._time_left = TimeLeft()
        self.told: set[str] = set()  # warnings, each of which is told once

    def is_cancelled(self) -> bool:
        """Return whether the user cancelled."""
        return self._feedback.isCanceled()

    def event(self, event: Event) -> None:
        """Show a progress report or a warning."""
        if event.kind == "warning":
            self.warn(str(event.data.get("message", "")))
        elif event.kind == "progress":
            self._progress(event.data)

    def warn(self, message: str) -> None:
        """Show a warning, once."""
        if message and message not in self.told:
            self.told.add(message)
            self._feedback.pushWarning(message)

    def line(self, text: str) -> None:
        """Show a line that is no event."""
        self._feedback.pushConsoleInfo(text)

    def _progress(self, data: dict[str, Any]) -> None:
        stage, done, total = str(data.get("stage", "")), data.get("done", 0), data.get("total", 0)
        whole_bar = (0, 100) if not self._stages else None
        begin, end = self._stages.get(stage) or whole_bar or (self._percent, self._percent)
        left = ""
        if total:
            percent = begin + (end - begin) * min(1.0, done / total)
            self._percent = max(self._percent, percent)  # the bar never goes back
            left = self._time_left.text(self._percent / 100.0)
            self._feedback.setProgress(self._percent)
        counts = [(data.get("placed"), tr("placed")), (data.get("rejected"), tr("rejected"))]
        counts_text = ", ".join(f"{count} {word}" for count, word in counts if count)
        text = f"{stage}: {data['message']}" if data.get("message") else f"{stage} {done}/{total}"
        text += f" ({counts_text})" if counts_text else ""
        self._feedback.setProgressText(f"{text}; {left}" if left else text)
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

    def __init__(self) -> None:
        super().__init__()
        self.warned: set[str] = set()

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
        """Return what the algorithm does, as HTML."""
        return "".join(f"<p>{html.escape(part, quote=False)}</p>" for part in tr(self.HELP).split("\n\n"))

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
        return help_page()

    def tags(self) -> list[str]:
        """Return words that find the algorithm in the toolbox."""
        return list(TAGS)

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
            words = {
                definition.name(): chosen_word(self, parameters, context, definition.name())
                for definition in self.parameterDefinitions()
                if isinstance(definition, QgsProcessingParameterEnum) and definition.name() in parameters
            }
        except QgsProcessingException as error:
            return False, str(error)
        return super().checkParameterValues({**parameters, **words}, context)

    def run_core(self, job: Job, feedback: QgsProcessingFeedback) -> dict[str, Any]:
        """Run a job and return the data of its result; raises `QgsProcessingException` with the remedy."""
        listener = FeedbackListener(feedback, self.STAGES)
        self.warned = listener.told
        try:
            return run_job(settings.interpreter(), job, listener, settings.worker_variables())
        except WorkerCancelled:
            raise QgsProcessingException(tr("Cancelled: the worker and all that it started have ended.")) from None
        except WorkerError as error:
            if error.diagnostics:
                settings.save_diagnostics(error.diagnostics)
                feedback.pushConsoleInfo(error.diagnostics)
            raise QgsProcessingException(str(error)) from None

    def warn(self, messages: Iterable[str], feedback: QgsProcessingFeedback) -> None:
        """Show warnings of a result that the worker has not told while it ran, each once."""
        for message in messages:
            if message not in self.warned:
                self.warned.add(message)
                feedback.pushWarning(message)


def chosen_word(
    algorithm: QgsProcessingAlgorithm, parameters: Mapping[str, Any], context: QgsProcessingContext, name: str
) -> str:
    """Return the word that a choice means: the word itself in any case, or its number; raises for anything else."""
    definition = algorithm.parameterDefinition(name)
    words, given = list(definition.options()), parameters.get(name)
    if given is None or given == "":
        given = definition.defaultValue()
    if not isinstance(given, (str, int)) or isinstance(given, bool):  # a property of a model or of a batch
        given = algorithm.parameterAsEnumString(dict(parameters), name, context)
    text = str(given).strip()
    found = next((word for word in words if word.lower() == text.lower()), None)
    if found is None and text.isascii() and text.isdigit() and int(text) < len(words):
        found = words[int(text)]
    if found is None:
        raise QgsProcessingException(
            tr("{}: {} is none of {} (or their numbers, 0 to {}).").format(
                definition.description(), text, ", ".join(words), len(words) - 1
            )
        )
    return found
