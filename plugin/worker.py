"""Jobs for the core in its own interpreter: a JSON file in, JSON lines out.

Standard library and the core's light modules only; QGIS hands in its feedback as a `Listener`.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from ..core.onthefly3r import __version__
from ..core.onthefly3r.protocol import Event, Job
from .explain import NO_INTERPRETER, SETUP, diagnostics, explain
from .process import clean_environ, stream

PLUGIN_FOLDER = Path(__file__).resolve().parents[1]
OLDEST_PYTHON = (3, 10)
_VERSION = "import sys; print(*sys.version_info[:2])"


class WorkerError(Exception):
    """The worker did not deliver; the message is for the user, `diagnostics` for whoever helps."""

    def __init__(self, message: str, diagnostics: str = "") -> None:
        super().__init__(message)
        self.diagnostics = diagnostics


class WorkerCancelled(Exception):
    """The user cancelled."""


class Listener(Protocol):
    """Who hears of a job while it runs."""

    def is_cancelled(self) -> bool:
        """Return whether the job shall end."""

    def event(self, event: Event) -> None:
        """Take a progress report or a warning."""

    def line(self, text: str) -> None:
        """Take a line that is no event."""


def run_job(python: str, job: Job, listener: Listener, variables: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Run one job to its end and return the data of its result; raises `WorkerError` and `WorkerCancelled`.

    `variables` are set for the worker beside what the environment has.
    """
    require_interpreter(python)
    told: dict[str, Any] = {}

    def take(text: str) -> None:
        try:
            event = Event.from_line(text)
        except ValueError:
            listener.line(text)
            return
        if event.kind in ("result", "error"):
            told[event.kind] = event.data
        else:
            listener.event(event)

    with tempfile.TemporaryDirectory(prefix="onthefly3r-") as folder:
        job_file = Path(folder) / "job.json"
        job.write(job_file)
        command = [python, "-m", "onthefly3r", "job", str(job_file)]
        try:
            ended = stream(command, worker_environ(variables), take, listener.is_cancelled)
        except OSError as error:
            raise _failure(f"{python} cannot be started ({error.strerror}): {SETUP}.", command, None, "") from error
    if ended.cancelled:
        raise WorkerCancelled
    if "result" in told and (ended.returncode == 0 or "error" in told):
        if "error" in told:  # a batch in which some flights failed: the others are there
            listener.event(Event("warning", told["error"]))
        return told["result"]
    message = explain(ended.returncode, told.get("error", {}).get("message"), ended.error_text)
    raise _failure(message, [*command, *job.words()], ended.returncode, ended.error_text)


def worker_environ(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the variables for the core: its own source first, nothing of QGIS, and `more`."""
    return {**clean_environ(os.environ, PLUGIN_FOLDER / "core"), **(more or {})}


def describe_backbones(
    python: str, is_cancelled: Callable[[], bool], variables: Mapping[str, str] | None = None
) -> list[dict[str, Any]]:
    """Return what `onthefly3r backbones` says of each one; empty where it says nothing."""
    lines: list[str] = []
    command = [python, "-m", "onthefly3r", "backbones", "--json"]
    try:
        stream(command, worker_environ(variables), lines.append, is_cancelled)
        described = json.loads("\n".join(lines))["backbones"]
        return [item for item in described if {"name", "installed", "weights", "next_step"} <= set(item)]
    except (OSError, ValueError, KeyError, TypeError):
        return []  # the run itself says why


def require_interpreter(python: str) -> None:
    """Raise `WorkerError` unless `python` is a Python that can run the core."""
    if not python:
        raise WorkerError(NO_INTERPRETER, _failure(NO_INTERPRETER, [], None, "").diagnostics)
    command = [python, "-c", _VERSION]
    version = python_version(python)
    if version is None:
        raise _failure(f"{python} is no Python that runs here: {SETUP}, or name another.", command, None, "")
    if version < OLDEST_PYTHON:
        found = ".".join(map(str, version))
        raise _failure(f"{python} is Python {found}; 3.10 or newer is needed: {SETUP}.", command, None, "")


def python_version(python: str) -> tuple[int, int] | None:
    """Return the version of an interpreter, None when it does not run."""
    try:
        told = subprocess.run(
            [python, "-c", _VERSION],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
            stdin=subprocess.DEVNULL,
            env=clean_environ(os.environ),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        ).stdout.split()
        return int(told[0]), int(told[1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return None


def _failure(message: str, command: list[str], returncode: int | None, error_text: str) -> WorkerError:
    facts = {"On-the-Fly3R": __version__}
    return WorkerError(message, diagnostics(message, command, returncode, error_text, facts))
