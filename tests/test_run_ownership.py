"""What verbs leave alone, what a stopped run leaves behind, and failures that must not cost the map."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from onthefly3r.commands.batch import Flight, reconstruct_flights
from onthefly3r.commands.cli import app
from onthefly3r.errors import InputError, require_memory
from onthefly3r.files.las_index import indexes_of
from onthefly3r.intake.folder import find_photographs
from onthefly3r.options import Options
from onthefly3r.simulate import SurveyOptions, simulate_survey
from oracle_runs import run, survey_of

ROOT = Path(__file__).resolve().parents[1]
TINY = SurveyOptions(images=5, strips=1, image_width_px=200, image_height_px=200)


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_batch_leaves_a_table_of_the_users_alone(tmp_path: Path) -> None:
    (tmp_path / "flights.csv").write_text("photos\na\n", encoding="utf-8")
    before = files(tmp_path)
    with pytest.raises(InputError, match=r"flights\.csv"):
        reconstruct_flights([Flight("a", tmp_path / "a")], tmp_path, Options())
    assert files(tmp_path) == before


def test_second_survey_replaces_the_first_and_only_that(tmp_path: Path) -> None:
    simulate_survey(tmp_path / "survey", TINY)
    (tmp_path / "survey" / "photos" / "mine.JPG").write_bytes(b"mine")
    simulate_survey(tmp_path / "survey", SurveyOptions(images=3, strips=1, image_width_px=200, image_height_px=200))
    assert len(list((tmp_path / "survey" / "photos").iterdir())) == 4
    assert (tmp_path / "survey" / "photos" / "mine.JPG").read_bytes() == b"mine"
    before = files(tmp_path / "survey" / "photos")
    with pytest.raises(InputError, match="not empty"):
        simulate_survey(tmp_path / "survey" / "photos", TINY)
    assert files(tmp_path / "survey" / "photos") == before


def test_check_and_export_leave_strangers_files_alone(tmp_path: Path) -> None:
    (tmp_path / "check.csv").write_text("mine", encoding="utf-8")
    (tmp_path / "cloud.laz").write_text("mine", encoding="utf-8")
    (tmp_path / "report.json").write_text("{}", encoding="utf-8")
    before = files(tmp_path)
    for verb in ("check", "run", "export"):
        shown = CliRunner().invoke(app, [verb, str(tmp_path), str(tmp_path)])
        assert shown.exit_code == 2, verb
        assert files(tmp_path) == before, verb


def test_results_of_an_earlier_release_are_not_taken_for_photographs_nor_deleted(tmp_path: Path) -> None:
    """They have no stamp: nothing in them can be proven to be ours."""
    simulate_survey(tmp_path / "survey", TINY)
    photos = tmp_path / "survey" / "photos"
    result = photos / "result"
    (result / "work").mkdir(parents=True)
    for name in ("preview.png", "report.json", "work/run.json", "work/journal.jsonl"):
        (result / name).write_text("{}", encoding="utf-8")
    assert len(find_photographs(photos, recursive=True)) == 5
    before = files(result)
    shown = CliRunner().invoke(app, ["run", str(photos), str(result)])
    assert shown.exit_code == 2
    assert "export' still reads it" in shown.stderr
    assert files(result) == before


def test_index_is_only_removed_where_it_was_made_from_the_cloud(tmp_path: Path) -> None:
    header = bytearray(375)
    header[:4], header[25] = b"LASF", 4
    header[247:255] = (1234).to_bytes(8, "little")
    (tmp_path / "cloud.laz").write_bytes(header)
    (tmp_path / "cloud.copc.laz").write_bytes(header)
    (tmp_path / "ept_cloud").mkdir()
    (tmp_path / "ept_cloud" / "ept.json").write_text('{"points": 99, "boundsConforming": [0,0,0,0,0,0]}')
    assert [index.path.name for index in indexes_of(tmp_path / "cloud.laz")] == ["cloud.copc.laz"]
    for index in indexes_of(tmp_path / "cloud.laz"):
        index.remove()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloud.laz", "ept_cloud"]


@pytest.mark.parametrize("error", [RuntimeError("Factor is exactly singular"), np.linalg.LinAlgError("SVD")])
def test_solver_that_fails_leaves_the_map_and_a_warning(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **named: Any) -> Any:
        raise error

    for name in ("optimise_submaps", "adjust_block"):
        monkeypatch.setattr(f"onthefly3r.engine.drift.{name}", fail)
    engine = run(tmp_path, survey_of(24, 2)).engine
    assert len(engine.state.frames) > 12
    engine.drift.refine()
    told = " ".join(engine.warnings)
    assert "the refinement failed" in told
    assert str(error) in told


def test_lack_of_memory_is_not_called_a_missing_package() -> None:
    with pytest.raises(MemoryError):
        require_memory(ImportError("libgtsam.so: failed to map segment from shared object"))
    with pytest.raises(MemoryError):
        require_memory(ImportError("libtorch.so: cannot allocate memory in static TLS block"))
    require_memory(ImportError("No module named 'gtsam'"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="of Linux")
def test_output_that_cannot_be_written_does_not_cost_the_work(tmp_path: Path) -> None:
    simulate = ["simulate", str(tmp_path / "out"), "--images=3", "--strips=1", "--image-width-px=200"]
    command = [sys.executable, "-m", "onthefly3r", *simulate, "--image-height-px=200"]
    environ = {**os.environ, "PYTHONPATH": str(ROOT / "core")}
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        ran = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environ, check=False)
    assert len(list((tmp_path / "out" / "photos").iterdir())) == 3
    assert ran.returncode == 4, ran.stderr
    assert "the work is done" in ran.stderr
    assert "Traceback" not in ran.stderr
    assert "Exception" not in ran.stderr
