"""Where the interpreter of the core is; kept in the user's QGIS settings, with a variable for servers.

The names are those of Processing's own settings, so that the provider's options page shows and edits them.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from qgis.core import QgsSettings
from qgis.PyQt.QtCore import QStandardPaths

PYTHON = "ONTHEFLY3R_PYTHON"  # the setting and the environment variable that goes before it
ENVIRONMENT = "ONTHEFLY3R_ENVIRONMENT"
MODELS = "ONTHEFLY3R_WEIGHTS"  # folder of the neural backbones' weights
CACHE = "ONTHEFLY3R_SCRATCH"  # folder of temporary files
RECENT = "onthefly3r/recent_runs"
MOST_RECENT = 10
DIAGNOSTICS = "onthefly3r/diagnostics"
_PREFIX = "Processing/Configuration/"
_STAMP = "onthefly3r-stamp.json"  # written by bootstrap.py when an environment is complete


def default_environment_folder() -> str:
    """Return a folder for the environment that outlives the plugin and the profile."""
    base = QStandardPaths.writableLocation(QStandardPaths.StandardLocation.GenericDataLocation)
    return str(Path(base) / "onthefly3r" / "environment")


def environment_folder() -> str:
    """Return the folder in which the environment is, or will be."""
    return _read(ENVIRONMENT) or default_environment_folder()


def interpreter() -> str:
    """Return the interpreter for the core, empty when there is none: variable, setting, environment."""
    named = os.environ.get(PYTHON) or _read(PYTHON)
    if named:
        return named if Path(named).is_file() else ""
    folder = Path(environment_folder())
    python = environment_python(folder)
    return str(python) if python.is_file() and (folder / _STAMP).is_file() else ""


def environment_python(folder: Path) -> Path:
    """Return the interpreter of an environment."""
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def save_environment(folder: str) -> None:
    """Remember where the environment is; it replaces an interpreter that was named before."""
    _write(ENVIRONMENT, folder)
    _write(PYTHON, "")


def save_interpreter(python: str) -> None:
    """Remember an interpreter that somebody else looks after."""
    _write(PYTHON, python)


def default_models_folder() -> str:
    """Return where weights are looked for when nothing is named."""
    return str(Path.home() / ".cache" / "onthefly3r")


def worker_variables() -> dict[str, str]:
    """Return the variables by which the worker learns the folders of weights and of temporary files."""
    models, cache = _read(MODELS), _read(CACHE)
    variables = {MODELS: models} if models else {}
    if cache and Path(cache).is_dir():
        variables.update(TMPDIR=cache, TEMP=cache, TMP=cache)
    return variables


def recent_runs() -> list[str]:
    """Return the folders of the last runs that are still there, the latest first."""
    try:
        told = json.loads(str(QgsSettings().value(RECENT, "") or "[]"))
        return [run for run in told if isinstance(run, str) and (Path(run) / "report.json").is_file()]
    except (ValueError, TypeError):
        return []


def save_run(folder: str) -> None:
    """Remember the folder of the last run."""
    others = [run for run in recent_runs() if run != folder]
    QgsSettings().setValue(RECENT, json.dumps([folder, *others][:MOST_RECENT]))


def last_report() -> str:
    """Return the page of the last run, empty when there is none any more."""
    pages = (Path(run) / "report.html" for run in recent_runs()[:1])
    return next((str(page) for page in pages if page.is_file()), "")


def diagnostics() -> str:
    """Return what was noted of the last failure."""
    return str(QgsSettings().value(DIAGNOSTICS, "") or "")


def save_diagnostics(text: str) -> None:
    """Note what a helper needs to know of a failure."""
    QgsSettings().setValue(DIAGNOSTICS, text)


def _read(name: str) -> str:
    return str(QgsSettings().value(_PREFIX + name, "") or "").strip()


def _write(name: str, value: str) -> None:
    from processing.core.ProcessingConfig import ProcessingConfig

    QgsSettings().setValue(_PREFIX + name, value)
    ProcessingConfig.setSettingValue(name, value)
