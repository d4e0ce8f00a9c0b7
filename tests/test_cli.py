"""The command line with an engine that only pretends: names, events, exit codes, cancelling."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from onthefly3r.commands.cli import app
from onthefly3r.errors import Cancelled, GeoreferenceError
from onthefly3r.files.ownership import Stamp
from onthefly3r.options import Options, iterate_options
from onthefly3r.protocol import Event, Progress

ROOT = Path(__file__).resolve().parents[1]
REPORT = {
    "georeference": {"crs": "EPSG:32633", "vertical": "egm96", "n_used": 9, "rmse_h_m": 0.4, "rmse_v_m": 0.6},
    "cloud": {"points": 1234567, "mean_spacing": 0.052, "unit": "m"},
    "timing": {"total_s": 61.0, "per_image_s": 6.1},
}


@dataclass(frozen=True)
class FakeResult:
    report: dict[str, Any]
    cloud: Path | None
    cameras: Path | None
    report_path: Path
    placed: int
    given: int


@dataclass
class FakeEngine:
    """Records the call; `trouble` is what happens after the first progress report."""

    trouble: Callable[[], None] = lambda: None
    options: Options | None = None

    def reconstruct(
        self, photos: Path, out: Path, options: Options, progress: Any, cancel: Any, anew: bool = False
    ) -> FakeResult:
        self.options = options
        progress(Progress("mapping", 4, 10, placed=4, rejected=1, waiting=5, eta_s=75.0))
        self.trouble()
        if cancel():
            raise Cancelled("stopped on request")
        progress(Progress("export", 10, 10, placed=9, rejected=1))
        return FakeResult(REPORT, out / "cloud.laz", out / "cameras.shp", out / "report.json", 9, 10)

    def export(self, run: Path, out: Path, options: Options, progress: Any, partial: bool = False) -> FakeResult:
        return self.reconstruct(run, out, options, progress, lambda: False)


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeEngine]:
    fake = FakeEngine()
    module = types.ModuleType("onthefly3r.run.session")
    module.reconstruct = fake.reconstruct  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "onthefly3r.run.session", module)
    again = types.ModuleType("onthefly3r.run.export")
    again.export = fake.export  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "onthefly3r.run.export", again)
    earlier = {"vertical": "egm96", "spacing_m": 0.25}
    monkeypatch.setattr("onthefly3r.run.record.earlier_options", lambda run: earlier)
    yield fake


def call(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def raise_(error: BaseException) -> Callable[[], None]:
    def trouble() -> None:
        raise error

    return trouble


def words(text: str) -> str:
    """Help text without the frame and line breaks that the terminal's width adds."""
    return re.sub(r"[\s│]+", " ", re.sub(r"\x1b\[[0-9;]*m", "", text))


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_explains_every_option_with_unit_and_default(flag: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    shown = call("run", flag)
    assert shown.exit_code == 0
    told = words(shown.output)
    for _, item in iterate_options():
        name = item.name.replace("_", "-")
        assert f"--{name} " in told
        assert item.metadata["help"] in told
        if isinstance(item.default, bool):
            assert f"--no-{name} " in told
        elif item.default is not None:
            unit = f" {item.metadata['unit']}" if item.metadata["unit"] else ""
            assert f"default: {item.default}{unit}" in told


def test_help_keeps_option_names_whole_at_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert "…" not in call("run", "-h").output


def test_options_reach_the_engine(engine: FakeEngine, tmp_path: Path) -> None:
    done = call(
        "run", tmp_path, tmp_path / "out", "--seed-size", "12", "--no-stray-filter", "--alpha", "20", "--crs",
        "EPSG:32633", "--pose-graph", "se3", "--spacing-m", "0.25", "--recursive",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    expected = {
        "seed_size": 12,
        "stray_filter": False,
        "alpha": 20.0,
        "crs": "EPSG:32633",
        "pose_graph": "se3",
        "spacing_m": 0.25,
    }
    assert engine.options == Options.from_flat(expected)


def test_paper_preset_reaches_the_engine_and_gives_way(engine: FakeEngine, tmp_path: Path) -> None:
    assert call("run", tmp_path, tmp_path / "out", "--preset", "paper", "--max-retries", "2").exit_code == 0
    assert engine.options == Options.from_flat({"preset": "paper", "max_retries": 2})


def test_export_takes_only_its_own_options_and_keeps_those_of_the_run(engine: FakeEngine, tmp_path: Path) -> None:
    assert call("export", tmp_path, tmp_path / "again", "--format", "las").exit_code == 0
    assert engine.options == Options.from_flat({"format": "las", "vertical": "egm96", "spacing_m": 0.25})
    assert call("export", tmp_path, tmp_path / "again", "--vertical", "egm2008").exit_code == 0
    assert engine.options == Options.from_flat({"vertical": "egm2008", "spacing_m": 0.25})
    assert call("export", tmp_path, tmp_path / "again", "--seed-size", "12").exit_code == 2


def test_summary_names_files_and_figures(engine: FakeEngine, tmp_path: Path) -> None:
    shown = call("run", tmp_path, tmp_path / "a folder with ümläuts")
    assert shown.exit_code == 0
    for part in ("9 of 10", "EPSG:32633", "egm96", "1,234,567", "0.052", "6.10 s per photograph"):
        assert part in shown.stdout
    for name in ("cloud.laz", "cameras.shp", "report.json"):
        assert str(tmp_path / "a folder with ümläuts" / name) in shown.stdout


def test_json_is_one_event_per_line_and_nothing_else(engine: FakeEngine, tmp_path: Path) -> None:
    def chatter() -> None:
        print("a library prints this")
        logging.getLogger("onthefly3r.intake").warning("DJI_0001.JPG: no position")

    engine.trouble = chatter
    shown = call("run", tmp_path, tmp_path / "out", "--json")
    assert shown.exit_code == 0
    events = [Event.from_line(line) for line in shown.stdout.splitlines()]
    assert [event.kind for event in events] == ["progress", "warning", "progress", "result"]
    assert events[0].data["stage"] == "mapping"
    assert events[0].data["waiting"] == 5
    assert events[1].data["message"] == "DJI_0001.JPG: no position"
    assert events[3].data["cloud"] == str(tmp_path / "out" / "cloud.laz")
    assert (events[3].data["placed"], events[3].data["given"]) == (9, 10)
    assert "a library prints this" in shown.stderr


def test_wrong_input_is_told_without_traceback(engine: FakeEngine, tmp_path: Path) -> None:
    photograph = tmp_path / "a.jpg"
    photograph.touch()
    cases = [
        ((tmp_path / "none", tmp_path / "out"), "does not exist"),
        ((photograph, tmp_path / "out"), "is a file"),
        ((tmp_path, tmp_path / "out", "--seed-size", "1"), "below the minimum of 3"),
        ((tmp_path, tmp_path / "out", "--pose-graph", "so3"), "se3"),
        ((tmp_path, tmp_path / "out", "--seed-size", "many"), "seed-size"),
        ((tmp_path,), "OUT"),
    ]
    for arguments, told in cases:
        shown = call("run", *arguments)
        assert shown.exit_code == 2, arguments
        assert told in shown.stderr
        assert "Traceback" not in shown.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "exit_code"),
    [
        (GeoreferenceError("only 2 usable positions: name --local"), 3),
        (KeyboardInterrupt(), 130),
        (Cancelled("stopped on request"), 130),
        (OSError(28, "No space left on device", "cloud.laz"), 4),
        (ModuleNotFoundError("No module named 'gtsam'"), 2),
        (MemoryError(), 1),
    ],
)
def test_exit_codes(error: BaseException, exit_code: int, engine: FakeEngine, tmp_path: Path) -> None:
    engine.trouble = raise_(error)
    shown = call("run", tmp_path, tmp_path / "out", "--json")
    assert shown.exit_code == exit_code
    last = Event.from_line(shown.stdout.splitlines()[-1])
    assert (last.kind, last.data["exit_code"]) == ("error", exit_code)
    assert last.data["message"]
    assert "Traceback" not in shown.output


@pytest.mark.parametrize("ours", [True, False])
def test_unexpected_error_leaves_a_traceback_in_work_only_where_that_is_ours(
    ours: bool, engine: FakeEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Elsewhere it goes to the temporary folder, under a name that nobody can plant a link at."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    out = tmp_path / "out"
    for folder in (out / "work", tmp_path / "temporary"):
        folder.mkdir(parents=True)
    (out / "work" / "thesis.txt").write_text("mine", encoding="utf-8")
    if ours:
        Stamp(map_open=True).write(out)
    engine.trouble = raise_(ZeroDivisionError("by nothing"))
    shown = call("run", tmp_path, out)
    assert shown.exit_code == 1
    assert "by nothing" in shown.stderr
    assert "Traceback" not in shown.output
    note = out / "work" / "crash.txt" if ours else next((tmp_path / "temporary").iterdir())
    assert str(note) in shown.stderr
    assert "ZeroDivisionError" in note.read_text(encoding="utf-8")
    assert (out / "work" / "crash.txt").exists() == ours


SLOW_ENGINE = """
import sys, time, types
engine = types.ModuleType("onthefly3r.run.session")
def reconstruct(photos, out, options, progress, cancel, anew=False):
    from onthefly3r.errors import Cancelled
    from onthefly3r.protocol import Progress
    import os, zlib
    import pycolmap  # brings a signal handler of its own
    os.write(1, b"native chatter\\n")
    try:
        for step in range(600):
            progress(Progress("mapping", step, 600))
            time.sleep(0.05)
    except Cancelled:
        os.write(2, b"the engine tidied up\\n")
        raise
engine.reconstruct = reconstruct
sys.modules["onthefly3r.run.session"] = engine
from onthefly3r.commands.cli import main
sys.argv = ["onthefly3r", *sys.argv[1:]]
main()
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no termination signal to send")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_a_real_process_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-c", SLOW_ENGINE, "run", str(tmp_path), str(tmp_path / "out"), "--json"]
    environ = {**os.environ, "PYTHONPATH": str(ROOT / "core")}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environ, cwd=tmp_path
    ) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        began = time.monotonic()
        process.send_signal(number)
        rest, errors = process.communicate(timeout=20)
    assert process.returncode == 130, errors
    assert time.monotonic() - began < 10
    events = [Event.from_line(line) for line in (first + rest).splitlines()]
    assert {event.kind for event in events} == {"progress", "error"}
    assert events[-1].data["exit_code"] == 130
    assert "native chatter" in errors
    assert "the engine tidied up" in errors
    assert "Traceback" not in errors


def test_file_names_survive_a_console_without_unicode(tmp_path: Path) -> None:
    environ = {**os.environ, "PYTHONPATH": str(ROOT / "core"), "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    ran = subprocess.run(
        [sys.executable, "-m", "onthefly3r", "run", "Фотографии", str(tmp_path / "out")],
        capture_output=True,
        env=environ,
        cwd=tmp_path,
        check=False,
    )
    assert ran.returncode == 2
    assert "Фотографии does not exist" in ran.stderr.decode("utf-8")


def test_doctor_reports_every_check_as_json() -> None:
    from onthefly3r.commands.doctor import PACKAGES

    shown = call("doctor", "--json")
    told = json.loads(shown.stdout)
    rows = {check["name"]: check for check in told["checks"]}
    assert {package.distribution for package in PACKAGES} <= set(rows)
    assert {"Python", "cores", "memory", "free disk", "PROJ data", "LAZ backend"} <= set(rows)
    assert rows["numpy"]["status"] == "ok"
    assert rows["numpy"]["found"][0].isdigit()
    assert all(check["remedy"] for check in told["checks"] if check["status"] == "missing")
    assert shown.exit_code == (0 if told["fit"] else 2)


def test_doctor_reports_crashing_and_broken_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from onthefly3r.commands import doctor

    (tmp_path / "crashes_on_import.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGABRT)\n")
    lacking = "raise ImportError('libEGL.so.1: cannot open shared object file: No such file or directory')\n"
    (tmp_path / "lacks_library.py").write_text(lacking)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    crashed = doctor.check_package(doctor.Package("crashes", "crashes_on_import"))
    assert crashed.status == "missing"
    assert "crashed" in crashed.found
    lacks = doctor.check_package(doctor.Package("lacks", "lacks_library", extra="cloud"))
    assert lacks.status == "note"
    assert "libEGL.so.1" in lacks.missing_libraries
    assert lacks.remedy.startswith("sudo apt-get install libegl1")
    absent = doctor.check_package(doctor.Package("absent", "no_such_module"))
    assert (absent.status, absent.remedy) == ("missing", "pip install absent")
    assert not doctor.is_fit([crashed, lacks])
    assert doctor.is_fit([lacks])


def test_view_says_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import laspy

    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.setenv("DISPLAY", ":0")
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=7))
    cloud.x = cloud.y = cloud.z = [1.0, 2.0]
    cloud.write(tmp_path / "cloud.laz")
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.las").write_text("no cloud")
    cases = {
        tmp_path: "onthefly3r[cloud]",
        tmp_path / "none.laz": "no such file",
        tmp_path / "empty": "holds no cloud.laz",
        tmp_path / "broken.las": "not a LAS or LAZ file",
    }
    for path, told in cases.items():
        shown = call("view", path)
        assert shown.exit_code == 2
        assert told in shown.stderr
    if sys.platform == "linux":
        monkeypatch.delenv("DISPLAY")
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        assert "no screen" in call("view", tmp_path).stderr


def test_refused_reconstruction_names_its_report(engine: FakeEngine, tmp_path: Path) -> None:
    def refuse() -> None:
        error = GeoreferenceError("only 2 usable positions: name --local")
        error.report, error.way_on = tmp_path / "out" / "report.json", "9 photographs are placed"
        raise error

    engine.trouble = refuse
    shown = call("run", tmp_path, tmp_path / "out")
    assert shown.exit_code == 3
    assert "only 2 usable positions" in shown.stderr
    assert str(tmp_path / "out" / "report.json") in shown.stderr
    assert "9 photographs are placed" in shown.stderr


def test_warnings_of_the_report_are_told_once(
    engine: FakeEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warn() -> None:
        logging.getLogger("onthefly3r").warning("heights drift")

    engine.trouble = warn
    monkeypatch.setitem(REPORT, "warnings", ["heights drift", "3 photographs without a position"])
    shown = call("run", tmp_path, tmp_path / "out", "--json")
    events = [Event.from_line(line) for line in shown.stdout.splitlines()]
    warnings = [event.data["message"] for event in events if event.kind == "warning"]
    assert warnings == ["heights drift", "3 photographs without a position"]


def test_evaluate_tells_how_far_apart_two_trajectories_are(tmp_path: Path) -> None:
    header = "image,x,y,z,omega,phi,kappa,status"
    rows = [(f"{number}.jpg", 10.0 * number, float(number**2), 5.0 * (number % 3)) for number in range(9)]
    for name, shift in (("ours.csv", 0.0), ("reference.csv", 0.3)):
        lines = [f"{image},{x},{y + shift * (-1) ** k},{z},0,0,0,placed" for k, (image, x, y, z) in enumerate(rows)]
        (tmp_path / name).write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    files = (tmp_path / "ours.csv", "--reference-poses", tmp_path / "reference.csv", "--align", "none")
    told = json.loads(call("evaluate", *files, "--json").stdout)
    assert told["kind"] == "result"
    assert told["poses"]["ate"] == pytest.approx(0.3)
    assert told["poses"]["coverage"] == 1.0
    assert "ATE" in call("evaluate", *files).stdout
    assert call("evaluate", tmp_path / "ours.csv").exit_code == 2
    assert call("evaluate", *files, "--align", "affine").exit_code == 2


def test_simulate_renders_what_was_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "survey"
    sizes = ("--images", 4, "--strips", 2, "--image-width-px", 240, "--image-height-px", 200)
    shown = call("simulate", out, *sizes, "--json")
    assert shown.exit_code == 0, shown.output
    assert Event.from_line(shown.stdout.splitlines()[-1]).data["given"] == 4
    assert len(list((out / "photos").iterdir())) == 4
    assert (out / "truth" / "images.txt").is_file()
    assert call("simulate", tmp_path / "none", "--images", 1).exit_code == 2
