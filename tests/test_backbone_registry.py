"""Finding backbones and their weights, and the list of them: all of it works without torch."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from onthefly3r.backbones import registry
from onthefly3r.backbones.listing import available_backbones, backbones_text
from onthefly3r.backbones.registry import backbone_targets, create_backbone, load_backbone
from onthefly3r.backbones.torch_runtime import ModelCard, TorchBackbone
from onthefly3r.commands import doctor
from onthefly3r.commands.cli import app
from onthefly3r.errors import MissingDependencyError, OptionError
from onthefly3r.networks.weights import find_weights
from onthefly3r.options import BackboneOptions


def test_weights_are_found_or_the_message_says_where_to_get_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = tmp_path / "flat.pt"
    weights.write_bytes(b"")
    monkeypatch.setenv("ONTHEFLY3R_WEIGHTS", str(tmp_path))
    assert find_weights("flat", None, "Get it.").path == weights
    assert find_weights("other", str(tmp_path), "Get it.").path == weights  # the only file of a folder
    with pytest.raises(OptionError, match=r"pi3: no weights\. Get it\. Then give --weights PATH"):
        find_weights("pi3", None, "Get it.")
    with pytest.raises(OptionError, match=r"missing\.pt: no such file\. Get it\."):
        find_weights("pi3", "some/missing.pt", "Get it.")
    with pytest.raises(OptionError, match="yyfz233/Pi3@COMMIT"):
        find_weights("pi3", "yyfz233/Pi3", "Get it.")


def test_hub_without_its_package_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingDependencyError, match="pip install huggingface_hub"):
        find_weights("pi3", "yyfz233/Pi3@0123abc", "Get it.")


def test_names_of_the_paper_and_the_built_in_ones_are_known() -> None:
    expected = {"classical", "pi3", "pi3x", "vggt", "vggt-omega", "mapanything", "da3"}
    assert expected <= set(backbone_targets())
    with pytest.raises(OptionError, match="did you mean pi3x"):
        create_backbone(BackboneOptions(backbone="pi4x"))
    with pytest.raises(OptionError, match="truth of a simulated survey"):
        create_backbone(BackboneOptions(backbone="oracle"))


def test_oracle_and_neural_backbones_are_imported_late() -> None:
    assert load_backbone("oracle").__name__ == "OracleBackbone"
    assert issubclass(load_backbone("pi3"), TorchBackbone)


def test_listing_says_what_to_do_next(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ONTHEFLY3R_WEIGHTS", str(tmp_path))
    rows = {item.name: item for item in available_backbones()}
    assert "oracle" not in rows
    assert "CC BY-NC" in rows["pi3"].licence
    assert not rows["vggt"].ready
    assert all(item.next_step for item in rows.values())
    assert (rows["classical"].ready, rows["classical"].state) == (True, "ready")
    text = backbones_text()
    assert rows["pi3x"].next_step in text  # on one line: addresses stay whole
    assert "4.2 GiB (subset of 10 photographs)" in text


def test_commands_list_the_same_backbones(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "vggt.safetensors").write_bytes(b"")
    monkeypatch.setenv("ONTHEFLY3R_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(ModelCard, "missing_packages", lambda card: [] if card.name == "vggt" else [card.module])
    shown = CliRunner().invoke(app, ["backbones", "--json"])
    assert shown.exit_code == 0
    told = {row["name"]: row for row in json.loads(shown.stdout)["backbones"]}
    assert told["vggt"] == {
        "name": "vggt",
        "installed": True,
        "weights": str(tmp_path / "vggt.safetensors"),
        "licence": "code VGGT licence (Meta); weights VGGT-1B non-commercial; VGGT-1B-Commercial on request",
        "memory_gib": 3.6,
        "next_step": "onthefly3r run PHOTOS OUT --backbone vggt",
        "ready": True,
    }
    assert not told["pi3"]["ready"]
    assert told["pi3"]["next_step"].startswith("pi3 missing: git clone")
    human = CliRunner().invoke(app, ["backbones"]).stdout
    checks = {check.name: check for check in doctor._backbones()}
    for name, row in told.items():
        assert f"{name}: " in human
        assert (checks[f"backbone {name}"].status == "ok") == row["ready"]
        assert checks[f"backbone {name}"].remedy == ("" if row["ready"] else row["next_step"])
    assert doctor.is_fit(list(checks.values()))  # nothing that the classical backbone needs


def test_listing_loads_no_heavy_package() -> None:
    code = (
        "import sys; from onthefly3r.backbones.listing import backbones_text; backbones_text();"
        "print(sorted({'torch', 'cv2', 'scipy', 'pycolmap', 'PIL'} & set(sys.modules)))"
    )
    core = Path(registry.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=core, check=True)
    assert done.stdout.strip() == "[]"


def test_without_torch_a_neural_backbone_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependencyError, match="torch") as error:
        create_backbone(BackboneOptions(backbone="da3"))
    assert error.value.exit_code == 2
    assert "pip install torch" in str(error.value)
    assert not any(item.installed for item in available_backbones() if item.weights is not None)
