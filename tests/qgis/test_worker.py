"""The border to the worker: cancelling, deaths, wrong interpreters, and what the user is told."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest


def descendants(of: int) -> set[int]:
    """Living processes that a process started, and that those started."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                state, parent = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
            except OSError:
                continue
            if state != "Z":
                parents[int(folder.name)] = int(parent)
    found: set[int] = set()
    new = {of}
    while new:
        new = {child for child, parent in parents.items() if parent in new} - found
        found |= new
    return found


def cancel_when(feedback: Any, word: str) -> list[float]:
    """Cancel as soon as the progress tells the word; gives a list that then holds the time."""
    moments: list[float] = []

    def look(text: str) -> None:
        if word in text and not moments:
            assert descendants(os.getpid())
            moments.append(time.monotonic())
            feedback.cancel()

    feedback.on_progress = look
    return moments


def flights_folder(survey: Path, parent: Path) -> Path:
    for name in ("a", "b"):
        shutil.copytree(survey / "photos", parent / name)
    return parent


@pytest.mark.parametrize("word", ["reading photographs", "starting the map"])
def test_cancel_ends_the_worker_and_leaves_a_folder_that_can_be_used_again(
    qgis: Any, survey: Path, feedback: Any, tmp_path: Path, word: str
) -> None:
    from qgis.core import QgsProcessingException

    parameters = {"PHOTOS": str(survey / "photos"), "OUTPUT": str(tmp_path / "out"), "QUALITY": "preview"}
    moments = cancel_when(feedback, word)
    with pytest.raises(QgsProcessingException, match="Cancelled"):
        qgis.run("onthefly3r:reconstruct", parameters, feedback=feedback)
    assert time.monotonic() - moments[0] < 2.0
    assert not descendants(os.getpid())
    assert not (tmp_path / "out" / "cloud.laz").exists()
    assert not list((tmp_path / "out").glob(".*.part*"))
    if word == "starting the map":
        assert qgis.run("onthefly3r:reconstruct", parameters)["PLACED"] == 12


def test_cancel_ends_the_children_of_the_worker_too(qgis: Any, survey: Path, feedback: Any, tmp_path: Path) -> None:
    from qgis.core import QgsProcessingException

    flights = flights_folder(survey, tmp_path / "flights")
    parameters = {"FOLDER": str(flights), "OUTPUT": str(tmp_path / "out"), "QUALITY": "preview"}
    seen: set[int] = set()

    def look(text: str) -> None:
        if "starting the map" in text and not seen:
            seen.update(descendants(os.getpid()))
            feedback.cancel()

    feedback.on_progress = look
    with pytest.raises(QgsProcessingException, match="Cancelled"):
        qgis.run("onthefly3r:reconstructflights", parameters, feedback=feedback)
    assert len(seen) >= 2  # the worker and the flight that it started
    deadline = time.monotonic() + 0.5
    while any(Path(f"/proc/{number}").exists() for number in seen) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(Path(f"/proc/{number}").exists() for number in seen)


@pytest.mark.parametrize(
    ("number", "told"),
    [(signal.SIGKILL, "memory did not suffice"), (signal.SIGSEGV, "library of the environment crashed")],
)
def test_worker_that_dies_in_mid_run(
    qgis: Any, plugin: Any, survey: Path, feedback: Any, tmp_path: Path, number: int, told: str
) -> None:
    from qgis.core import QgsProcessingException

    def look(text: str) -> None:
        if "reading photographs" in text:
            for process in descendants(os.getpid()):
                os.kill(process, number)

    feedback.on_progress = look
    with pytest.raises(QgsProcessingException, match=told):
        qgis.run(
            "onthefly3r:reconstruct",
            {"PHOTOS": str(survey / "photos"), "OUTPUT": str(tmp_path / "out")},
            feedback=feedback,
        )
    text = plugin("plugin.settings").diagnostics()
    assert f"exit status: {-number}" in text and "command: " in text
    assert text in feedback.told


def test_without_an_interpreter(qgis: Any, monkeypatch: pytest.MonkeyPatch, survey: Path, tmp_path: Path) -> None:
    from qgis.core import QgsApplication, QgsProcessingException

    monkeypatch.delenv("ONTHEFLY3R_PYTHON")
    for algorithm in QgsApplication.processingRegistry().providerById("onthefly3r").algorithms():
        possible, why = algorithm.canExecute()
        assert possible == (algorithm.name() in ("setup", "loadresults"))
        assert possible or "Set up processing environment" in why
    with pytest.raises(QgsProcessingException, match="Set up processing environment"):
        qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(survey / "photos"), "OUTPUT": str(tmp_path / "out")})


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("#!/bin/sh\nexit 3\n", "is no Python that runs here"),
        ("#!/bin/sh\necho 3 8\n", "is Python 3.8; 3.10 or newer is needed"),
    ],
)
def test_wrong_interpreters(
    qgis: Any, monkeypatch: pytest.MonkeyPatch, survey: Path, tmp_path: Path, script: str, told: str
) -> None:
    from qgis.core import QgsProcessingException

    python = tmp_path / "python"
    python.write_text(script)
    python.chmod(0o755)
    monkeypatch.setenv("ONTHEFLY3R_PYTHON", str(python))
    with pytest.raises(QgsProcessingException, match=told):
        qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(survey / "photos"), "OUTPUT": str(tmp_path / "out")})


def test_interpreter_without_the_packages(
    qgis: Any, monkeypatch: pytest.MonkeyPatch, survey: Path, tmp_path: Path
) -> None:
    from qgis.core import QgsProcessingException

    monkeypatch.setenv("ONTHEFLY3R_PYTHON", sys.executable)
    with pytest.raises(QgsProcessingException, match=r"lacks the Python package '\w+': run 'Set up"):
        qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(survey / "photos"), "OUTPUT": str(tmp_path / "out")})


def test_wrong_folders(qgis: Any, tmp_path: Path) -> None:
    from qgis.core import QgsProcessingException

    (tmp_path / "empty").mkdir()
    with pytest.raises(QgsProcessingException, match="nowhere is no folder"):
        qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(tmp_path / "nowhere"), "OUTPUT": str(tmp_path / "out")})
    with pytest.raises(QgsProcessingException, match="no JPEG, PNG or TIFF file in it"):
        qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(tmp_path / "empty"), "OUTPUT": str(tmp_path / "out")})
    with pytest.raises(QgsProcessingException, match=r"empty holds no report\.json"):
        qgis.run("onthefly3r:exportcameras", {"RUN": str(tmp_path / "empty"), "CAMERAS": "TEMPORARY_OUTPUT"})


def test_output_folder_with_other_things_is_left_alone(qgis: Any, survey: Path, tmp_path: Path) -> None:
    from qgis.core import QgsProcessingException

    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(QgsProcessingException, match=r"holds precious\.txt"):
        qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(survey / "photos"), "OUTPUT": str(tmp_path)})
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


def test_core_is_that_of_the_plugin(plugin: Any, core_python: str, profiles: Path) -> None:
    environ = plugin("plugin.worker").worker_environ()
    script = "import onthefly3r; print(onthefly3r.__file__)"
    ran = subprocess.run([core_python, "-c", script], env=environ, capture_output=True, text=True, check=True)
    assert Path(ran.stdout.strip()).is_relative_to(profiles)


def test_environment_is_clean(plugin: Any) -> None:
    led_astray = dict.fromkeys(
        ("PYTHONHOME", "PYTHONPATH", "VIRTUAL_ENV", "PROJ_LIB", "GDAL_DATA", "LD_LIBRARY_PATH"), "x"
    )
    clean = plugin("plugin.process").clean_environ({**led_astray, "PATH": "/bin", "Proj_Data": "x"}, Path("core"))
    assert clean == {
        "PATH": "/bin",
        "PYTHONPATH": "core",
        "PYTHONUTF8": "1",
        "PYTHONNOUSERSITE": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }


def test_stream_hands_over_every_line_and_the_end_of_the_errors(plugin: Any) -> None:
    script = (
        "import sys\nfor i in range(2000): print('zeile', i, 'ü')\nsys.stderr.write('x' * 50000 + 'last')\nsys.exit(7)"
    )
    lines: list[str] = []
    ended = plugin("plugin.process").stream(
        [sys.executable, "-c", script], {**os.environ, "PYTHONUTF8": "1"}, lines.append, lambda: False
    )
    assert lines == [f"zeile {i} ü" for i in range(2000)]
    assert (ended.returncode, ended.cancelled) == (7, False)
    assert ended.error_text.endswith("xlast") and len(ended.error_text) == 20_000


def test_stream_ends_a_silent_program_that_ignores_the_polite_signal(plugin: Any) -> None:
    script = (
        "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('on', flush=True)\ntime.sleep(60)"
    )
    lines: list[str] = []
    began: list[float] = []

    def cancelled() -> bool:
        if lines:
            began.append(time.monotonic())
        return bool(lines)

    ended = plugin("plugin.process").stream([sys.executable, "-c", script], os.environ, lines.append, cancelled)
    assert ended.cancelled and ended.returncode == -signal.SIGKILL
    assert time.monotonic() - began[0] < 2.0


@pytest.mark.parametrize(
    ("status", "errors", "told"),
    [
        (-9, "", "memory did not suffice"),
        (137, "", "memory did not suffice"),
        (0xC0000017, "", "memory did not suffice"),
        (-11, "", "crashed (signal 11)"),
        (0xC0000005, "", "crashed (status 0xC0000005)"),
        (-1073741819, "", "crashed (status 0xC0000005)"),
        (0xC0000135, "", "Visual C++ Redistributable"),
        (1, "ModuleNotFoundError: No module named 'laspy'\n", "lacks the Python package 'laspy'"),
        (1, "SyntaxError: invalid syntax\n", "Python 3.10 or newer"),
        (5, "line one\nline two\n\n", "status 5: line two"),
        (5, "", "told no reason"),
    ],
)
def test_explain(plugin: Any, status: int, errors: str, told: str) -> None:
    assert told in plugin("plugin.explain").explain(status, None, errors)


def test_what_the_worker_says_goes_before_guesses(plugin: Any) -> None:
    assert plugin("plugin.explain").explain(2, "the folder is empty", "noise") == "the folder is empty"
