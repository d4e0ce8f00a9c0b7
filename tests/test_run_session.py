"""Runs that were stopped and go on, with the classical backbone on a few rendered photographs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from onthefly3r import Options, reconstruct
from onthefly3r.errors import Cancelled, InputError, OptionError
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.protocol import Progress
from onthefly3r.run.session import resume
from onthefly3r.simulate import SurveyOptions, simulate_survey

FAST = {"dense_px": 100, "threads": 2, "seed_size": 6, "rasters": False, "orthophoto": "none"}


class Stopping:
    """Ends a run at the n-th word of one stage."""

    def __init__(self, stage: str, times: int = 1) -> None:
        self._stage = stage
        self._left = times

    def __call__(self, progress: Progress) -> None:
        self._left -= progress.stage == self._stage
        if self._left <= 0:
            raise Cancelled("stopped on request")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    simulate_survey(folder, SurveyOptions(images=10, strips=2, image_width_px=400, image_height_px=300, seed=2))
    return folder / "photos"


@pytest.fixture(scope="module")
def whole(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    assert reconstruct(photos, out, Options.from_flat(FAST)).placed == 10
    return out


def stopped(photos: Path, out: Path, stage: str, times: int = 1) -> None:
    with pytest.raises(Cancelled) as stop:
        reconstruct(photos, out, Options.from_flat(FAST), Stopping(stage, times))
    assert "onthefly3r resume" in str(stop.value.way_on)  # type: ignore[attr-defined]


def assert_same_result(out: Path, whole: Path) -> None:
    assert (out / "work" / "journal.jsonl").read_bytes() == (whole / "work" / "journal.jsonl").read_bytes()
    one, other = (MapState.load(Store(folder / "work")) for folder in (out, whole))
    for index in other.frames:
        np.testing.assert_array_equal(one.map_from_cam(index).matrix(), other.map_from_cam(index).matrix())
    assert (out / "cameras.dbf").read_bytes() == (whole / "cameras.dbf").read_bytes()
    reports = [json.loads((folder / "report.json").read_text(encoding="utf-8")) for folder in (out, whole)]
    assert (
        reports[0]["images"] == reports[1]["images"] and reports[0]["cloud"]["points"] == reports[1]["cloud"]["points"]
    )
    assert reports[0]["warnings"] == reports[1]["warnings"]
    assert sorted(path.name for path in (out / "work").iterdir()) == ["chunks", "journal.jsonl", "run.json"]


def test_two_runs_of_the_same_photographs_are_the_same(photos: Path, whole: Path, tmp_path: Path) -> None:
    reconstruct(photos, tmp_path / "out", Options.from_flat(FAST))
    assert_same_result(tmp_path / "out", whole)


@pytest.mark.parametrize("stage", ["reading photographs", "starting the map", "reconstructing", "georeferencing"])
def test_a_run_that_was_stopped_goes_on(photos: Path, whole: Path, tmp_path: Path, stage: str) -> None:
    out = tmp_path / "out"
    stopped(photos, out, stage)
    told: list[Progress] = []
    if stage == "reconstructing":
        reconstruct(photos, out, Options.from_flat({**FAST, "threads": 1}), told.append)
    else:
        resume(out, {}, told.append)
    assert_same_result(out, whole)
    stages = {progress.stage for progress in told}
    assert ("starting the map" in stages) == (stage in ("reading photographs", "starting the map"))
    assert ("reconstructing" in stages) == (stage != "georeferencing")


def test_a_run_beside_a_finished_one_goes_on_too(photos: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    stopped(photos, out, "reconstructing")
    assert (out / "cloud.laz").exists()
    resume(out)
    assert_same_result(out, whole)


def test_what_would_change_the_map_is_refused_and_the_rest_is_used(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    stopped(photos, out, "reconstructing")
    for name, value in {"dense_px": 120, "validation": False, "gps_sigma_h_m": 9.0}.items():
        with pytest.raises(OptionError, match=f"^{name}: "):
            reconstruct(photos, out, Options.from_flat({**FAST, name: value}))
        with pytest.raises(OptionError, match=f"^{name}: "):
            resume(out, {name: value})
    result = resume(out, {"format": "las", "crs": "EPSG:3035"})
    assert result.cloud is not None and result.cloud.name == "cloud.las"
    assert result.report["georeference"]["crs"] == "EPSG:3035"
    with pytest.raises(InputError, match="nothing to go on with"):
        resume(out)


def test_other_photographs_do_not_go_on_and_more_do(photos: Path, tmp_path: Path) -> None:
    out, some = tmp_path / "out", tmp_path / "photos"
    some.mkdir()
    names = sorted(path.name for path in photos.glob("*.JPG"))
    for name in names[:8]:
        shutil.copy2(photos / name, some / name)
    stopped(some, out, "reconstructing")
    kept = (some / names[2]).read_bytes()
    (some / names[2]).write_bytes((photos / names[9]).read_bytes())
    with pytest.raises(InputError, match=names[2]):
        reconstruct(some, out, Options.from_flat(FAST))
    (some / names[2]).write_bytes(kept)  # copied again: the same by content
    for name in names[8:]:
        shutil.copy2(photos / name, some / name)
    assert reconstruct(some, out, Options.from_flat(FAST)).placed == 10


def test_begin_anew(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    stopped(photos, out, "reconstructing")
    told: list[Progress] = []
    other = Options.from_flat({**FAST, "dense_px": 120})
    assert reconstruct(photos, out, other, told.append, anew=True).placed == 10
    assert "starting the map" in {progress.stage for progress in told}


def test_photographs_that_are_gone_are_told(photos: Path, tmp_path: Path) -> None:
    moved = tmp_path / "photos"
    shutil.copytree(photos, moved)
    stopped(moved, tmp_path / "out", "reconstructing")
    moved.rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="connect their drive"):
        resume(tmp_path / "out")
    assert reconstruct(tmp_path / "elsewhere", tmp_path / "out", Options.from_flat(FAST)).placed == 10
