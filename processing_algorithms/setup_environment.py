"""Set up processing environment: the interpreter in which the core computes."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
    QgsProcessingParameterString,
)

from ..plugin import settings
from ..plugin.process import clean_environ, stream
from ..plugin.worker import OLDEST_PYTHON, PLUGIN_FOLDER, python_version, worker_environ
from .base import CoreAlgorithm, tr
from .parameters import add

FOLDER, PYTHON, EXISTING, NEURAL = "FOLDER", "PYTHON", "EXISTING", "NEURAL"
EXPECTED_LINES = 90  # that pip tells while it installs; only for the bar


class SetUpEnvironment(CoreAlgorithm):
    """Makes the environment with `bootstrap.py`, or takes one that exists."""

    NAME = "setup"
    TITLE = "Set up processing environment"
    ICON = "setup.svg"
    needs_environment = False
    HELP = (
        "Makes the Python environment in which On-the-Fly3R computes, outside QGIS. Needed once; about 0.8 GB, some "
        "minutes, the network, and no administrator rights. Run it again after an update of the plugin, or when it was "
        "cancelled: it goes on where it can, and does nothing where nothing is missing.\n\nWithout internet: make the "
        "environment on another computer of the same kind, copy it, and name its Python under 'Existing Python'."
    )

    def initAlgorithm(self, config: dict[str, Any] | None = None) -> None:
        """Declare parameters and outputs."""
        add(
            self,
            QgsProcessingParameterFile(
                FOLDER,
                tr("Folder of the environment"),
                QgsProcessingParameterFile.Behavior.Folder,
                defaultValue=settings.environment_folder(),
                optional=True,
            ),
            tr("It is made. Empty: {}. 1.2 GB must be free while installing.").format(
                settings.default_environment_folder()
            ),
        )
        add(
            self,
            QgsProcessingParameterString(EXISTING, tr("Existing Python"), optional=True),
            tr("Path of an interpreter that has the packages already; nothing is installed then, it is only checked."),
        )
        add(
            self,
            QgsProcessingParameterBoolean(NEURAL, tr("Neural backbones too"), defaultValue=False),
            tr("Installs torch as well: several GB more. Only needed for other backbones than 'classical'."),
            advanced=True,
        )
        add(
            self,
            QgsProcessingParameterString(PYTHON, tr("Python to make it with"), optional=True),
            tr("Path of a Python 3.10 or newer, 64 bit, with the module venv. Empty: QGIS's own or the system's."),
            advanced=True,
        )
        self.addOutput(QgsProcessingOutputString("INTERPRETER", tr("Interpreter")))
        self.addOutput(QgsProcessingOutputString("CHECKS", tr("What was checked, as JSON")))

    def processAlgorithm(
        self, parameters: dict[str, Any], context: QgsProcessingContext, feedback: QgsProcessingFeedback
    ) -> dict[str, Any]:
        """Make or check the environment, then remember it."""
        existing = self.parameterAsString(parameters, EXISTING, context).strip()
        if existing:
            checks = self._check(existing, feedback)
            settings.save_interpreter(existing)
            return {"INTERPRETER": existing, "CHECKS": checks}
        folder = self.parameterAsString(parameters, FOLDER, context).strip() or settings.default_environment_folder()
        base = find_python(self.parameterAsString(parameters, PYTHON, context).strip())
        command = [base, str(PLUGIN_FOLDER / "bootstrap.py"), "setup", "--environment", folder]
        if self.parameterAsBoolean(parameters, NEURAL, context):
            command += ["--extra", "neural"]
        feedback.pushInfo(tr("Making the environment in {} with {}").format(folder, base))
        self._stream(command, feedback)
        python = str(settings.environment_python(Path(folder)))
        checks = self._check(python, feedback)
        settings.save_environment(folder)
        return {"INTERPRETER": python, "CHECKS": checks}

    def _stream(self, command: list[str], feedback: QgsProcessingFeedback) -> None:
        told: list[str] = []

        def take(line: str) -> None:
            told.append(line)
            feedback.pushConsoleInfo(line)
            feedback.setProgress(min(90.0, 90.0 * len(told) / EXPECTED_LINES))

        try:
            ended = stream(command, clean_environ(os.environ), take, feedback.isCanceled)
        except OSError as error:
            raise QgsProcessingException(tr("{} cannot be started ({}).").format(command[0], error.strerror)) from error
        if ended.cancelled:
            raise QgsProcessingException(tr("Cancelled. Run it again to complete the environment."))
        if ended.returncode != 0:
            raise QgsProcessingException("\n".join(told[-12:]) or ended.error_text or str(ended.returncode))

    def _check(self, python: str, feedback: QgsProcessingFeedback) -> str:
        """Ask `onthefly3r doctor` and return its answer; raises what is missing with the remedies."""
        version = python_version(python)
        if version is None or version < OLDEST_PYTHON:
            found = tr("no Python that runs here") if version is None else "Python " + ".".join(map(str, version))
            raise QgsProcessingException(tr("{} is {}; Python 3.10 or newer is needed.").format(python, found))
        feedback.pushInfo(tr("Checking {}").format(python))
        told: list[str] = []
        ended = stream(
            [python, "-m", "onthefly3r", "doctor", "--json"], worker_environ(), told.append, feedback.isCanceled
        )
        if ended.cancelled:
            raise QgsProcessingException(tr("Cancelled. Run it again to complete the environment."))
        try:
            answer = json.loads("\n".join(told))
            missing = [check for check in answer["checks"] if check["status"] == "missing"]
        except (ValueError, KeyError, TypeError):
            last = (ended.error_text.strip().splitlines() or ["-"])[-1]
            raise QgsProcessingException(
                tr(
                    "{} lacks packages of On-the-Fly3R ({}). Leave 'Existing Python' empty to make an environment."
                ).format(python, last)
            ) from None
        for check in answer["checks"]:
            feedback.pushInfo(f"{check['status']:<8} {check['name']}: {check['found']} {check['remedy']}".rstrip())
        if missing:
            lines = [f"{check['name']}: {check['found']}; {check['remedy']}" for check in missing]
            raise QgsProcessingException(tr("Not fit yet:") + "\n" + "\n".join(lines))
        feedback.setProgress(100)
        return "\n".join(told)


def find_python(named: str) -> str:
    """Return a Python to make the environment with; raises `QgsProcessingException` when there is none."""
    if named:
        version = python_version(named)
        if version is None or version < OLDEST_PYTHON:
            raise QgsProcessingException(tr("{} is no Python 3.10 or newer that runs here.").format(named))
        return named
    for candidate in python_candidates():
        version = python_version(candidate)
        if version is not None and version >= OLDEST_PYTHON:
            return candidate
    raise QgsProcessingException(
        tr(
            "No Python 3.10 or newer was found. Install one (python.org, or your system's packages) and name it under "
            "'Python to make it with' in the advanced parameters."
        )
    )


def python_candidates() -> list[str]:
    """Return interpreters that may be there, QGIS's own first; QGIS's program itself is none."""
    places = [
        sys.executable if Path(sys.executable or "").name.lower().startswith("python") else "",
        str(Path(sys.exec_prefix, "python.exe")),
        str(Path(sys.exec_prefix, "bin", "python3")),
        str(Path(sys.executable or "", "..", "bin", "python3").resolve()),
        *(shutil.which(name) or "" for name in ("python3", "python3.13", "python3.12", "python3.11", "python3.10")),
        shutil.which("python") or "",
    ]
    return [place for place in dict.fromkeys(places) if place and Path(place).is_file()]
