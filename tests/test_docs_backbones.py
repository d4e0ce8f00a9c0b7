"""The page on backbones: its code runs as it stands there, and its table says what the adapters say."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones.registry import BUILT_IN, create_backbone, load_backbone
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.options import BackboneOptions, SelectionOptions
from onthefly3r.records import LocalModel, Shot, Subset, WorkingImage

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PAGE = (Path(__file__).parents[1] / "docs" / "backbones.md").read_text(encoding="utf-8")
OWN_MODEL = PAGE.split("## Add your own model in 40 lines")[1].split("\n## ")[0]

# What the documented adapter expects of the model's own package.
UPSTREAM = '''
import torch

class Network(torch.nn.Module):
    """Flat ground 4 units before cameras that move along x; the raw confidence rises to the right."""

    def __init__(self):
        super().__init__()
        self.depth = torch.nn.Parameter(torch.zeros(1))

    def forward(self, images):
        _, count, _, height, width = images.shape
        pose = torch.eye(4).repeat(1, count, 1, 1)
        pose[0, :, 0, 3] = -torch.arange(count)
        camera = torch.tensor([500.0, 510.0, width / 2.0, height / 2.0])
        return {
            "cam_from_world": pose,
            "fx_fy_cx_cy": camera.repeat(1, count, 1),
            "depth": self.depth.expand(1, count, height, width),
            "confidence": 1.0 + torch.linspace(-3.0, 3.0, width).exp().expand(1, count, height, width),
        }
'''


def fenced(language: str) -> str:
    """The only block of a language in the section on adding a model."""
    (block,) = re.findall(rf"```{language}\n(.*?)```", OWN_MODEL, flags=re.DOTALL)
    return str(block)


def test_documented_adapter_runs_from_its_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")
    code, metadata = fenced("python"), tomllib.loads(fenced("toml"))
    assert len(code.splitlines()) <= 45  # "in 40 lines": blank ones are not counted
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 40
    (tmp_path / "mypackage").mkdir()
    (tmp_path / "mypackage" / "__init__.py").write_text("")
    (tmp_path / "mypackage" / "adapter.py").write_text(code)
    (tmp_path / "mymodel.py").write_text(UPSTREAM)
    written = tmp_path / "mypackage-1.0.dist-info"
    written.mkdir()
    (written / "METADATA").write_text("Metadata-Version: 2.1\nName: mypackage\nVersion: 1.0\n")
    ((group, points),) = metadata["project"]["entry-points"].items()
    lines = [f"[{group}]", *(f"{name} = {target}" for name, target in points.items())]
    (written / "entry_points.txt").write_text("\n".join(lines) + "\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    torch.save({"depth": torch.tensor([4.0])}, tmp_path / "mymodel.pt")

    backbone = create_backbone(
        BackboneOptions(backbone="mymodel", weights=str(tmp_path / "mymodel.pt"), device="cpu", threads=1)
    )
    rgb = np.zeros((750, 1000, 3), np.uint8)
    images = {
        k: WorkingImage(Shot(f"{k}.jpg", Path("x"), 4000, 3000, "k", 0.8, 0.05, "guess"), rgb, PixelMap(0.25, 0.25))
        for k in range(4)
    }
    model = backbone.reconstruct(Subset((0, 1), (2, 3)), images, {})
    assert isinstance(model, LocalModel)
    for k, view in model.views.items():
        assert view.points.shape == (392, 518, 3)
        assert view.local_from_cam.translation == pytest.approx([k, 0.0, 0.0])
        cam_points = view.local_from_cam.inverse().apply(view.points.astype(float))
        assert np.abs(view.camera.project(cam_points) - view.camera.pixel_centres()).max() < 0.02
        assert cam_points[..., 2] == pytest.approx(4.0)  # the weights, not random ones
        assert np.all(np.diff(view.confidence, axis=1) > 0.0)
    assert set(model.views) == {0, 1, 2, 3}
    for name in ("mypackage", "mypackage.adapter", "mymodel"):
        monkeypatch.delitem(sys.modules, name)


def test_table_says_what_the_adapters_say() -> None:
    table = PAGE.split("| name | model |")[1].split("\n\n")[0]
    rows = {cells[1].strip(" `"): cells for cells in (line.split("|") for line in table.splitlines()[2:])}
    assert set(rows) == set(BUILT_IN)
    for name, (_, _, _, code, weights, memory, *_) in rows.items():
        card = getattr(load_backbone(name), "card", None)
        if card is None:
            continue
        assert memory.strip() == ("not published" if card.memory_gib is None else f"{card.memory_gib:g} GiB")
        assert code.split()[0] in card.code_licence
        for licence in ("CC BY-NC 4.0", "Apache-2.0", "on request", "gated"):
            assert (licence in weights) == (licence in card.weights_licence), name


def test_descriptors_are_those_of_the_option() -> None:
    table = PAGE.split("| `--descriptor` |")[1].split("\n\n")[0]
    named = re.findall(r"^\| `(\w+)`", table, flags=re.MULTILINE)
    field = SelectionOptions.__dataclass_fields__["descriptor"]
    assert tuple(named) == field.metadata["choices"]
    assert f"`{field.default}` (default)" in table
