"""Many flights in one go, each in a process of its own."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from onthefly3r.commands import batch
from onthefly3r.commands.batch import Flight, read_flights, reconstruct_flights
from onthefly3r.commands.cli import app
from onthefly3r.errors import Cancelled, InputError
from onthefly3r.options import Options
from onthefly3r.protocol import Job, Progress

REPORT = {
    "error": None,
    "images": {"given": 5, "placed": 4},
    "georeference": {"crs": "EPSG:32633", "rmse_h_m": 0.5, "rmse_v_m": 0.7},
    "cloud": {"points": 1000},
    "timing": {"total_s": 3.0},
    "memory": {"peak_rss_mib": 200.0},
}


def photographs(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "a.jpg").write_bytes(b"")
    return folder


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A core that only pretends: it does what the name of the folder of photographs says, and notes its jobs."""
    package = tmp_path / "pretended" / "onthefly3r"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    script = f"""
        import json, os, pathlib, signal, sys, time
        job = json.loads(pathlib.Path(sys.argv[2]).read_text())
        photos, out = map(pathlib.Path, job["arguments"])
        with open({str(tmp_path / "jobs")!r}, "a") as log:
            log.write(json.dumps(job) + "\\n")
        def tell(kind, **data):
            print(json.dumps({{"kind": kind, "time_s": 0.0, **data}}), flush=True)
        tell("progress", stage="reconstructing", done=2, total=4, placed=2, rejected=0, waiting=2)
        print("noise that is no event", flush=True)
        if photos.name == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if photos.name == "wrong":
            tell("error", message="the folder is empty", exit_code=2)
            sys.exit(2)
        if photos.name == "endless":
            time.sleep(60)
        report = json.loads({json.dumps(json.dumps(REPORT))})
        out.mkdir(parents=True, exist_ok=True)
        if photos.name == "poor":
            report.update(error="too little overlap", images={{"given": 5, "placed": 0}}, georeference=None, cloud=None)
        (out / "report.json").write_text(json.dumps(report))
        if photos.name == "poor":
            tell("error", message="too little overlap", exit_code=3)
            sys.exit(3)
        tell("result")
    """
    (package / "__main__.py").write_text(textwrap.dedent(script))
    monkeypatch.setattr(batch, "SOURCE", package.parent)
    return tmp_path / "jobs"


def flights(parent: Path, *names: str) -> list[Flight]:
    return [Flight(name, photographs(parent / name)) for name in names]


def test_a_failed_flight_does_not_stop_the_others(worker: Path, tmp_path: Path) -> None:
    told: list[Progress] = []
    chosen = flights(tmp_path / "day", "killed", "wrong", "poor", "fine")
    rows = reconstruct_flights(chosen, tmp_path / "out", Options(), progress=told.append)
    assert [row.status for row in rows] == ["failed", "failed", "failed", "done"]
    assert "memory did not suffice" in rows[0].message
    assert rows[1].message == "the folder is empty" and rows[1].given is None
    assert rows[2].message == "too little overlap" and (rows[2].given, rows[2].placed) == (5, 0)
    fine = rows[3]
    assert (fine.given, fine.placed, fine.crs, fine.rmse_h_m, fine.points) == (5, 4, "EPSG:32633", 0.5, 1000)
    assert fine.report == str(tmp_path / "out" / "fine" / "report.html")
    with (tmp_path / "out" / "flights.csv").open(encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    assert [row["flight"] for row in table] == ["killed", "wrong", "poor", "fine"]
    assert table[3]["placed"] == "4" and table[0]["placed"] == ""
    done = [report.done for report in told]
    assert done == sorted(done) and done[-1] == told[-1].total == 400
    assert any(report.message == "reconstructing" and report.done % 100 == 49 for report in told)


def test_options_reach_every_flight_and_its_own_go_first(worker: Path, tmp_path: Path) -> None:
    chosen = flights(tmp_path / "day", "one", "two")
    chosen[1] = Flight("two", chosen[1].photos, {"working_px": 700, "preset": "paper"})
    reconstruct_flights(chosen, tmp_path / "out", Options.from_flat({"crs": "EPSG:25833", "working_px": 500}))
    jobs = [json.loads(line) for line in worker.read_text().splitlines()]
    assert [job["verb"] for job in jobs] == ["run", "run"]
    assert jobs[0]["options"] == {"crs": "EPSG:25833", "working_px": 500}
    assert jobs[1]["options"] == {"crs": "EPSG:25833", "working_px": 700, "preset": "paper"}
    assert jobs[1]["arguments"] == [str(tmp_path / "day" / "two"), str(tmp_path / "out" / "two")]


def test_what_is_done_is_skipped_on_request(worker: Path, tmp_path: Path) -> None:
    chosen = flights(tmp_path / "day", "poor", "fine")
    reconstruct_flights(chosen, tmp_path / "out", Options())
    rows = reconstruct_flights(chosen, tmp_path / "out", Options(), skip_done=True)
    assert [row.status for row in rows] == ["failed", "skipped"]
    assert rows[1].placed == 4
    assert len(worker.read_text().splitlines()) == 3


def test_cancelling_ends_the_flight(worker: Path, tmp_path: Path) -> None:
    told: list[Progress] = []
    chosen = flights(tmp_path / "day", "fine", "endless", "never")
    began = time.monotonic()
    with pytest.raises(Cancelled):
        reconstruct_flights(
            chosen,
            tmp_path / "out",
            Options(),
            progress=told.append,
            cancel=lambda: any(report.stage == "endless" for report in told),
        )
    assert time.monotonic() - began < 20.0
    assert len(worker.read_text().splitlines()) == 2
    with (tmp_path / "out" / "flights.csv").open(encoding="utf-8") as stream:
        assert [row["flight"] for row in csv.DictReader(stream)] == ["fine"]


def test_parent_folder(tmp_path: Path) -> None:
    photographs(tmp_path / "b" / "DCIM")
    photographs(tmp_path / "a")
    photographs(tmp_path / ".hidden")
    (tmp_path / "documents").mkdir()
    assert read_flights(tmp_path) == [Flight("a", tmp_path / "a"), Flight("b", tmp_path / "b")]


def test_table(tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    text = "\ufeffname;photos;crs;working_px;recursive;spacing_m\nNord/1;a;EPSG:25833;800;off;0.5\n;sub/b;;;;\n\n"
    path.write_text(text, encoding="utf-8")
    one, two = read_flights(path)
    assert one.name == "Nord_1" and one.photos == tmp_path / "a"
    assert one.options == {"crs": "EPSG:25833", "working_px": 800, "recursive": False, "spacing_m": 0.5}
    assert two == Flight("b", tmp_path / "sub" / "b")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "column photos"),
        ("name,folder\na,b\n", "column photos"),
        ("photos,name\n,x\n", "line 2: names no folder"),
        ("photos,working_px\na,5\n", "line 2: working_px: 5 is below"),
        ("photos,colour\na,red\n", "line 2: unknown option colour"),
        ("photos\nx/a\ny/A\n", "the name a occurs 2 times"),
        ("photos,name\na,..\n", "is no name for a flight"),
    ],
)
def test_wrong_tables_are_told(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "flights.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_flights(path)


def test_wrong_sources_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none of its sub-folders"):
        read_flights(tmp_path)
    with pytest.raises(InputError, match="no table of flights"):
        read_flights(tmp_path / "missing.csv")


def test_command_line_ends_its_flight_when_it_is_told_to_stop(tmp_path: Path) -> None:
    """The real thing: SIGTERM to the batch, and no process is left."""
    simulated = tmp_path / "day" / "one"
    python = [sys.executable, "-m", "onthefly3r"]
    survey = ["--images=9", "--strips=3", "--image-width-px=400", "--image-height-px=300", str(simulated)]
    subprocess.run([*python, "simulate", *survey], check=True, capture_output=True)
    job = Job("batch", (str(tmp_path / "day"), str(tmp_path / "out")), {"working_px": 300})
    process = subprocess.Popen(
        [*python, *job.words()], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, start_new_session=True
    )
    timer = threading.Timer(60.0, process.kill)
    timer.start()
    lines: list[dict[str, Any]] = []
    with process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(json.loads(line))
            if len(lines) == 1:
                process.send_signal(signal.SIGTERM)
    timer.cancel()
    assert process.returncode == Cancelled.exit_code
    assert lines[-1]["kind"] == "error" and "stopped on request" in lines[-1]["message"]
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


@pytest.mark.parametrize(("names", "exit_code"), [(("good",), 0), (("good", "wrong"), 3)])
def test_exit_code_says_whether_a_flight_failed(
    worker: Path, tmp_path: Path, names: tuple[str, ...], exit_code: int
) -> None:
    for name in names:
        photographs(tmp_path / "day" / name)
    shown = CliRunner().invoke(app, ["batch", str(tmp_path / "day"), str(tmp_path / "out")])
    assert shown.exit_code == exit_code
    assert ("1 of 2 flights failed: wrong" in shown.stderr) == (exit_code == 3)


def test_a_named_option_wins_over_the_preset_even_if_it_is_the_default(worker: Path, tmp_path: Path) -> None:
    options = Options.from_flat({"preset": "paper", "max_retries": 3})
    reconstruct_flights(flights(tmp_path, "good"), tmp_path / "out", options)
    (job,) = [json.loads(line) for line in worker.read_text().splitlines()]
    assert job["options"] == {"preset": "paper", "max_retries": 3}
