"""Where the interpreter of the core is; kept in the user's QGIS settings, with a variable for servers.

The names are those of Processing's own settings, so that the provider's options page shows and edits them.
"""

from __future__ import annotations

import os
from pathlib import Path

from qgis.core import QgsSettings
from qgis.PyQt.QtCore import QStandardPaths

PYTHON = "ONTHEFLY3R_PYTHON"  # the setting and the environment variable that goes before it
ENVIRONMENT = "ONTHEFLY3R_ENVIRONMENT"
LAST_REPORT = "onthefly3r/last_report"
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


def last_report() -> str:
    """Return the page of the last run, empty when there is none any more."""
    path = str(QgsSettings().value(LAST_REPORT, "") or "")
    return path if path and Path(path).is_file() else ""


def save_last_report(path: str) -> None:
    """Remember the page of the last run."""
    QgsSettings().setValue(LAST_REPORT, path)


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
