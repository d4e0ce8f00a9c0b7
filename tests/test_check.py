"""Photographs looked at before they are processed, on rendered ones whose overlap is known."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageFilter
from typer.testing import CliRunner

from onthefly3r.commands import estimate
from onthefly3r.commands.check import CheckedPhotograph, check_photographs, write_check
from onthefly3r.commands.cli import app
from onthefly3r.errors import Cancelled, InputError
from onthefly3r.options import Options
from onthefly3r.protocol import Progress
from onthefly3r.simulate import simulate_survey
from onthefly3r.simulate.flight import SurveyOptions

SURVEY = SurveyOptions(images=12, strips=3, image_width_px=640, image_height_px=480)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("survey")
    simulate_survey(out, SURVEY)
    return out / "photos"


@pytest.fixture
def photos(survey: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    shutil.copytree(survey, tmp_path / "photos")
    return tmp_path / "photos"


def row(rows: tuple[CheckedPhotograph, ...], image: str) -> CheckedPhotograph:
    return next(item for item in rows if item.image == image)


def change(path: Path, how: Any) -> None:
    """Change the pixels of a photograph and keep its tags."""
    with Image.open(path) as image:
        exif, xmp = image.info["exif"], image.info["xmp"]
        changed = how(image.convert("RGB"))
    changed.save(path, quality=92, exif=exif, xmp=xmp)


def without_tags(path: Path) -> None:
    with Image.open(path) as image:
        rgb = image.convert("RGB")
    rgb.save(path)


def test_good_flight(survey: Path) -> None:
    checked = check_photographs(survey)
    summary = checked.summary()
    assert (summary["given"], summary["good"], summary["with_position"]) == (12, 12, 12)
    assert summary["crs"] == "EPSG:32633" and summary["vertical"] == "ellipsoidal"
    assert summary["warnings"] == []
    # The plan overlaps by 80 % along the strips and 65 % across them; the strips are flown with some noise.
    assert summary["median_best_overlap"] == pytest.approx(0.8, abs=0.06)
    assert summary["above_ground_m"] == pytest.approx(80.0, abs=3.0)
    assert summary["gsd_m"] == pytest.approx(80.0 / 8.8 * 13.2 / 640.0, rel=0.08)
    assert 0.7 < summary["covered"] <= 1.0
    assert summary["estimated_time_s"] > 0.0 and 300.0 < summary["estimated_memory_mib"] < 2000.0


def test_footprint_lies_under_the_camera(survey: Path) -> None:
    for item in check_photographs(survey).photographs:
        centre = np.mean(item.footprint, axis=0)
        assert np.linalg.norm(centre - [item.x, item.y]) < 15.0  # nadir within a few degrees, 80 m above ground


def test_problems_are_told_for_each_photograph(photos: Path) -> None:
    change(photos / "SIM_0002.JPG", lambda image: image.filter(ImageFilter.GaussianBlur(1.5)))
    change(photos / "SIM_0004.JPG", lambda image: image.point(lambda value: value // 40))
    change(photos / "SIM_0006.JPG", lambda image: image.point(lambda value: min(255, value * 4)))
    change(photos / "SIM_0008.JPG", lambda image: Image.new("RGB", image.size, (90, 110, 130)))
    without_tags(photos / "SIM_0010.JPG")
    (photos / "SIM_0012.JPG").write_bytes((photos / "SIM_0012.JPG").read_bytes()[:20_000])
    shutil.copy(photos / "SIM_0001.JPG", photos / "copy.jpg")
    (photos / "notes.png").write_text("no image")
    rows = check_photographs(photos).photographs
    for image, verdict, problem in (
        ("SIM_0001.JPG", "good", ""),
        ("SIM_0002.JPG", "doubtful", "blurred"),
        ("SIM_0004.JPG", "doubtful", "too dark"),
        ("SIM_0006.JPG", "doubtful", "too bright"),
        ("SIM_0008.JPG", "doubtful", "hardly any contrast"),
        ("SIM_0010.JPG", "doubtful", "no position in the tags"),
        ("SIM_0012.JPG", "unusable", "cannot be decoded"),
        ("copy.jpg", "unusable", "the same file as SIM_0001.JPG"),
        ("notes.png", "unusable", "no readable JPEG, PNG or TIFF"),
    ):
        item = row(rows, image)
        assert item.verdict == verdict
        assert problem in " ".join(item.problems)
    assert row(rows, "SIM_0001.JPG").problems == ()


def test_lonely_photograph_has_no_overlap(photos: Path) -> None:
    for path in sorted(photos.iterdir())[1:-1]:
        if path.name != "SIM_0002.JPG":
            path.unlink()
    rows = check_photographs(photos).photographs
    lonely = row(rows, "SIM_0012.JPG")
    assert lonely.verdict == "doubtful"
    assert any(problem.startswith("overlap of 19 % with its best neighbour") for problem in lonely.problems)
    assert (row(rows, "SIM_0001.JPG").best_overlap or 0.0) > 0.6


def test_named_height_goes_before_the_tags_and_sets_the_ground(survey: Path) -> None:
    low, high = (check_photographs(survey, above_ground_m=height).summary() for height in (40.0, 160.0))
    assert low["above_ground_m"] == 40.0
    assert high["gsd_m"] == pytest.approx(4.0 * low["gsd_m"], rel=0.01)
    assert low["median_best_overlap"] == pytest.approx(0.6, abs=0.08)  # half the height, twice the gap
    assert high["median_best_overlap"] > 0.85


def without_flying_height(photos: Path) -> None:
    for path in photos.iterdir():
        path.write_bytes(path.read_bytes().replace(b"RelativeAltitude", b"NothingOfMeaning"))


def test_flying_height_is_measured_where_the_tags_have_none(photos: Path) -> None:
    without_flying_height(photos)
    summary = check_photographs(photos).summary()
    assert summary["above_ground_m"] == pytest.approx(80.0, rel=0.1)
    assert summary["median_best_overlap"] == pytest.approx(0.8, abs=0.08)
    assert any("measured between photographs" in warning for warning in summary["warnings"])


def test_flying_height_stays_unknown_where_photographs_share_nothing(photos: Path) -> None:
    without_flying_height(photos)
    for seed, path in enumerate(sorted(photos.iterdir())):
        noise = np.random.default_rng(seed).integers(0, 255, (480, 640, 3), np.uint8)
        change(path, lambda image, noise=noise: Image.fromarray(noise))
    checked = check_photographs(photos)
    assert checked.summary()["above_ground_m"] is None
    assert any("name the height above ground" in warning for warning in checked.warnings)


def test_without_any_position(photos: Path) -> None:
    for path in photos.iterdir():
        without_tags(path)
    checked = check_photographs(photos)
    assert checked.crs is None
    told = " ".join(checked.summary()["warnings"])
    assert "12 of 12 photographs have no position" in told
    assert "cannot be georeferenced" in told and "no flying height" in told and "focal length" in told
    assert all(item.verdict == "doubtful" and item.footprint == () for item in checked.photographs)


def test_options_of_the_planned_run_count(survey: Path) -> None:
    standard = check_photographs(survey, Options.from_flat({"crs": "EPSG:25833"}))
    assert standard.crs == "EPSG:25833"
    coarse = check_photographs(survey, Options.from_flat({"working_px": 300, "limit": 6}))
    assert len(coarse.photographs) == 6
    assert coarse.memory_mib < standard.memory_mib


def test_time_follows_from_features_and_sizes(survey: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count(step=3)  # three seconds for the three photographs that are timed
    monkeypatch.setattr(estimate.time, "perf_counter", lambda: float(next(clock)))
    standard = check_photographs(survey, Options.from_flat({"threads": 1}))
    assert standard.time_s == pytest.approx(12 * (1.0 + 6.0 + 25.0 * 0.25))
    two_cores = check_photographs(survey, Options.from_flat({"threads": 2, "dense_px": 250}))
    assert two_cores.time_s == pytest.approx(12 * (1.0 + 6.0 + 25.0 * 0.0625) / 2)
    assert check_photographs(survey, Options.from_flat({"backbone": "pi3"})).time_s is None


def test_files(survey: Path, tmp_path: Path) -> None:
    checked = check_photographs(survey)
    doubtful = replace(checked.photographs[0], problems=("one", "two"))
    checked = replace(checked, photographs=(doubtful, *checked.photographs[1:]))
    path = write_check(tmp_path / "out", checked)
    told = json.loads(path.read_text(encoding="utf-8"))
    assert told["summary"] == checked.summary()
    assert [item["image"] for item in told["photographs"]] == [item.image for item in checked.photographs]
    with (tmp_path / "out" / "check.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert rows[0]["problems"] == "one; two" and "footprint" not in rows[0]
    assert float(rows[1]["x"]) == checked.photographs[1].x


def test_command_line(survey: Path, tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, ["check", str(survey), str(tmp_path), "--above-ground-m", "40", "--json"])
    assert ran.exit_code == 0
    events = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [event["kind"] for event in events] == ["progress"] * 12 + ["warning", "result"]
    assert "of the ground is in three photographs" in events[-2]["message"]
    assert events[-1]["above_ground_m"] == 40.0 and events[-1]["given"] == 12
    assert events[-1]["check"] == str(tmp_path / "check.json") and (tmp_path / "check.csv").is_file()


def test_progress_and_cancelling(survey: Path) -> None:
    told: list[Progress] = []
    check_photographs(survey, progress=told.append)
    assert [(report.done, report.total) for report in told] == [(i, 12) for i in range(1, 13)]
    with pytest.raises(Cancelled):
        check_photographs(survey, progress=told.append, cancel=lambda: len(told) > 14)
    assert len(told) < 20


def test_folder_must_be_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        check_photographs(tmp_path / "nowhere")
