"""The algorithm that makes the environment, without downloading one."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(autouse=True)
def settings(plugin: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The plugin's settings, empty before and after."""
    monkeypatch.delenv("ONTHEFLY3R_PYTHON")
    chosen = plugin("plugin.settings")
    yield chosen
    chosen.save_environment("")


def test_existing_python_is_checked_and_remembered(qgis: Any, core_python: str, settings: Any, feedback: Any) -> None:
    told = qgis.run("onthefly3r:setup", {"EXISTING": core_python}, feedback=feedback)
    assert told["INTERPRETER"] == core_python
    assert json.loads(told["CHECKS"])["fit"] is True
    assert settings.interpreter() == core_python
    assert any("pycolmap" in line for line in feedback.told)


def test_python_without_the_packages_is_not_taken(qgis: Any, settings: Any) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match="lacks packages of On-the-Fly3R"):
        qgis.run("onthefly3r:setup", {"EXISTING": sys.executable})
    assert settings.interpreter() == ""


def test_nothing_is_no_python(qgis: Any, tmp_path: Path) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match=r"is no Python that runs here; Python 3\.10 or newer is needed"):
        qgis.run("onthefly3r:setup", {"EXISTING": str(tmp_path / "none")})


def test_without_the_network_the_remedy_is_told(
    qgis: Any, settings: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from qgis.core import QgsProcessingException

    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(QgsProcessingException, match="package index cannot be reached"):
        qgis.run("onthefly3r:setup", {"FOLDER": str(tmp_path / "environment"), "PYTHON": sys.executable})
    assert settings.interpreter() == ""


def test_cancelled_it_ends_within_two_seconds_and_can_be_repeated(
    qgis: Any, settings: Any, feedback: Any, tmp_path: Path
) -> None:
    from qgis.core import QgsProcessingException

    began: list[float] = []

    def take(text: str) -> None:
        feedback.told.append(text)
        if text.startswith("Making the environment"):
            began.append(time.monotonic())
            feedback.cancel()

    feedback.pushConsoleInfo = take
    parameters = {"FOLDER": str(tmp_path / "environment"), "PYTHON": sys.executable}
    with pytest.raises(QgsProcessingException, match="Run it again to complete"):
        qgis.run("onthefly3r:setup", parameters, feedback=feedback)
    assert time.monotonic() - began[0] < 2.0
    assert settings.interpreter() == ""
    assert not (tmp_path / "environment" / "onthefly3r-stamp.json").exists()


def test_finds_a_python_that_is_not_qgis_itself(plugin: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    setup = plugin("processing_algorithms.setup_environment")
    qgis_binary = tmp_path / "qgis-bin"
    qgis_binary.write_text("")
    monkeypatch.setattr(sys, "executable", str(qgis_binary))
    assert str(qgis_binary) not in setup.python_candidates()
    assert Path(setup.find_python("")).name.startswith("python")


def test_disk_and_default_folder(plugin: Any, settings: Any) -> None:
    folder = Path(settings.default_environment_folder())
    assert folder.parts[-2:] == ("onthefly3r", "environment")
    assert os.environ.get("QGIS_CUSTOM_CONFIG_PATH", "nowhere") not in str(folder)
