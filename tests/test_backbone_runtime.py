"""The torch runtime: weights, strict load, memory that runs out, devices; and the registry and its listing."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones import registry
from onthefly3r.backbones.conventions import NetworkImage, Prediction, network_image
from onthefly3r.backbones.listing import available_backbones
from onthefly3r.backbones.registry import create_backbone, load_backbone
from onthefly3r.backbones.torch_runtime import ModelCard, TorchBackbone
from onthefly3r.errors import MissingDependencyError, OptionError
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.networks.weights import load_strict, read_state
from onthefly3r.options import BackboneOptions
from onthefly3r.records import LocalModel, Rejection, Shot, Subset, WorkingImage

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")


class Flat(TorchBackbone):
    """A network of one layer that sees a plane; the whole of a third party's adapter."""

    card = ModelCard(
        name="flat",
        module="numpy",
        install="pip install numpy",
        code_licence="MIT",
        weights_licence="MIT",
        weights_source="Download flat.pt.",
        confidence_threshold=0.5,
        memory_gib=0.1,
    )
    fitting = 99  # images that fit into memory
    batches: list[int]

    def prepare(self, image: WorkingImage) -> NetworkImage:
        return network_image(image, 28, 14, "BICUBIC")

    def build(self, state, config):
        self.batches = []
        return torch.nn.Linear(2, 2), state

    def predict(self, network, images) -> Prediction:
        count, _, height, width = images.shape[1:]
        self.batches.append(count)
        if count > self.fitting:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        print("upstream chatter")
        points = np.ones((count, height, width, 3))
        return Prediction(
            np.repeat(np.eye(4)[None], count, axis=0),
            points,
            np.full((count, height, width), 0.7),
            np.repeat([[20.0, 20.0, 14.0, 7.0]], count, axis=0),
        )


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.save(torch.nn.Linear(2, 2).state_dict(), tmp_path / "flat.pt")
    return tmp_path / "flat.pt"


def images(count: int) -> dict[int, WorkingImage]:
    rgb = np.zeros((30, 60, 3), np.uint8)
    return {
        n: WorkingImage(Shot(f"{n}.jpg", Path(f"{n}.jpg"), 60, 30, "k", 0.8, 0.05, "guess"), rgb, PixelMap())
        for n in range(count)
    }


def flat(weights: Path, fitting: int = 99) -> Flat:
    backbone = Flat(BackboneOptions(backbone="flat", weights=str(weights), device="cpu"))
    backbone.fitting = fitting
    return backbone


def test_everything_fits(weights: Path, capfd: pytest.CaptureFixture[str]) -> None:
    model = flat(weights).reconstruct(Subset((0, 1), (2, 3)), images(4), {})
    assert isinstance(model, LocalModel)
    assert set(model.views) == {0, 1, 2, 3}
    assert model.left_out == ()
    assert capfd.readouterr().out == ""  # standard output carries events


def test_out_of_memory_halves_the_new_images_and_is_remembered(weights: Path) -> None:
    backbone = flat(weights, fitting=6)
    model = backbone.reconstruct(Subset((0, 1, 2), tuple(range(3, 11))), images(11), {})
    assert isinstance(model, LocalModel)
    assert set(model.views) == {0, 1, 2, 3, 4}  # 3 + 8 and 3 + 4 do not fit, 3 + 2 do
    assert model.left_out == (5, 6, 7, 8, 9, 10)
    backbone.reconstruct(Subset((0, 1, 2), tuple(range(3, 11))), images(11), {})
    assert backbone.batches == [11, 7, 5, 5]


def test_out_of_memory_with_one_new_image_takes_fewer_references(weights: Path) -> None:
    backbone = flat(weights, fitting=5)
    for _ in range(2):
        model = backbone.reconstruct(Subset(tuple(range(8)), (8, 9, 10)), images(11), {})
        assert isinstance(model, LocalModel)
        assert set(model.views) == {0, 1, 2, 3, 8}
        assert model.left_out == (9, 10)
    assert backbone.batches == [11, 9, 5, 5]


def test_out_of_memory_with_one_new_image_is_a_rejection(weights: Path) -> None:
    outcome = flat(weights, fitting=3).reconstruct(Subset((0, 1, 2), (3, 4)), images(5), {})
    assert isinstance(outcome, Rejection)
    assert (outcome.stage, outcome.images) == ("backbone", (3, 4))
    assert "out of memory" in outcome.reason
    seed = flat(weights, fitting=1).reconstruct(Subset((), (0, 1, 2, 3)), images(4), {})
    assert isinstance(seed, Rejection)


def test_other_errors_of_a_network_are_not_taken_for_memory(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> Prediction:
        raise RuntimeError("shape mismatch")

    monkeypatch.setattr(Flat, "predict", fail)
    with pytest.raises(RuntimeError, match="shape mismatch"):
        flat(weights).reconstruct(Subset((0,), (1,)), images(2), {})


def test_licence_is_said_once(weights: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="onthefly3r.backbones"):
        backbone = flat(weights)
        for _ in range(2):
            backbone.reconstruct(Subset((0,), (1,)), images(2), {})
    assert [record.getMessage() for record in caplog.records] == ["flat: licence: code MIT; weights MIT"]
    assert backbone.spec.licence == "code MIT; weights MIT"
    assert backbone.spec.version == "flat.pt"


def test_report_knows_the_weights_from_others(weights: Path) -> None:
    import hashlib

    assert flat(weights).spec.facts() == {
        "name": "flat",
        "version": "flat.pt",
        "licence": "code MIT; weights MIT",
        "weights": {
            "file": "flat.pt",
            "source": "flat.pt",
            "revision": None,
            "bytes": weights.stat().st_size,
            "sha256": hashlib.sha256(weights.read_bytes()).hexdigest(),
        },
    }


def test_network_that_does_not_fit_at_all_is_told_at_the_start(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(torch.nn.Module, "to", full)
    with pytest.raises(OptionError, match="network alone does not fit"):
        flat(weights)


def test_device_that_is_not_there(weights: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has an NVIDIA GPU")
    with pytest.raises(OptionError, match="choose auto or cpu"):
        Flat(BackboneOptions(backbone="flat", weights=str(weights), device="cuda"))


def test_strict_load_lists_keys(tmp_path: Path) -> None:
    network = torch.nn.Linear(2, 2)
    state = network.state_dict()
    with pytest.raises(OptionError, match=r"1 missing \(bias\); 1 unexpected \(offset\)"):
        load_strict(network, {"weight": state["weight"], "offset": state["bias"]}, "x.pt")
    with pytest.raises(OptionError, match="shapes do not fit"):
        load_strict(network, {"weight": torch.zeros(3, 2), "bias": state["bias"]}, "x.pt")
    load_strict(network, {**state, "depth_emb.x": torch.zeros(1)}, "x.pt", spare=("depth_emb",))
    with pytest.raises(OptionError, match="no numbers: 1 in"):
        load_strict(network, {**state, "bias": torch.full((2,), torch.nan)}, "x.pt")


def test_strict_load_takes_tied_tensors_under_one_name() -> None:
    network = torch.nn.ModuleDict({"a": torch.nn.Linear(2, 2), "b": torch.nn.Linear(2, 2)})
    network["b"].weight = network["a"].weight
    state = {key: torch.ones_like(value) for key, value in network.state_dict().items() if key != "b.weight"}
    load_strict(network, state, "x.pt")
    assert torch.equal(network["b"].weight, torch.ones(2, 2))


def test_weights_are_read_without_unpickling(tmp_path: Path) -> None:
    torch.save({"state_dict": {"a": torch.ones(1)}}, tmp_path / "wrapped.pt")
    assert list(read_state(tmp_path / "wrapped.pt")) == ["a"]
    torch.save({"a": Path("x")}, tmp_path / "objects.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "wrapped.pt").read_bytes()[:300])
    (tmp_path / "text.safetensors").write_bytes(b"no such format")
    torch.save([1, 2], tmp_path / "list.pt")
    for name in ("objects.pt", "cut.pt", "text.safetensors", "list.pt"):
        with pytest.raises(OptionError, match=name):
            read_state(tmp_path / name)


def test_safetensors_are_read(tmp_path: Path) -> None:
    save_file = pytest.importorskip("safetensors.torch", reason="safetensors is not installed").save_file
    save_file({"a": torch.arange(3.0)}, tmp_path / "model.safetensors")
    assert torch.equal(read_state(tmp_path / "model.safetensors")["a"], torch.arange(3.0))


def test_missing_code_stops_before_anything_runs(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Flat, "card", ModelCard("flat", "no_such_package_0", "pip install it", "", "", "", 0.5))
    with pytest.raises(MissingDependencyError, match="no_such_package_0 missing; pip install it") as error:
        flat(weights)
    assert error.value.exit_code == 2


def test_upstream_code_that_lacks_a_package_of_its_own(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build(*_: object) -> None:
        import no_such_package_0  # noqa: F401

    monkeypatch.setattr(Flat, "build", build)
    with pytest.raises(MissingDependencyError, match="No module named 'no_such_package_0'"):
        flat(weights)


def test_other_packages_add_backbones_but_cannot_take_our_names(monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    points = [
        metadata.EntryPoint("flat", f"{__name__}:Flat", registry.GROUP),
        metadata.EntryPoint("pi3", f"{__name__}:Flat", registry.GROUP),
        metadata.EntryPoint("gone", "no_such_package_0:Backbone", registry.GROUP),
    ]
    monkeypatch.setattr(registry.metadata, "entry_points", lambda group: points if group == registry.GROUP else [])
    monkeypatch.setitem(sys.modules, __name__, sys.modules[Flat.__module__])
    backbone = create_backbone(BackboneOptions(backbone="flat", weights=str(weights)))
    assert backbone.spec.name == "flat"
    assert load_backbone("pi3").__name__ == "Pi3"
    with pytest.raises(MissingDependencyError, match="no_such_package_0"):
        load_backbone("gone")
    monkeypatch.setenv("ONTHEFLY3R_WEIGHTS", str(weights.parent))
    rows = {item.name: item for item in available_backbones()}
    assert rows["flat"].ready
    assert rows["flat"].weights == str(weights)
    assert rows["flat"].memory_gib == 0.1
    assert not rows["gone"].installed
    assert "no_such_package_0" in rows["gone"].next_step
