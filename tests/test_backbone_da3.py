"""Depth Anything 3 built from its PyPI code with random weights, against what its own network answers."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones.conventions import compose
from onthefly3r.backbones.registry import create_backbone
from onthefly3r.errors import OptionError
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.options import BackboneOptions
from onthefly3r.records import LocalModel, Shot, Subset, WorkingImage

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")
for package in ("depth_anything_3", "addict", "einops", "omegaconf", "safetensors"):
    if importlib.util.find_spec(package) is None:
        pytest.skip(
            f"{package} is not installed: pip install --no-deps depth-anything-3==0.1.1; "
            "pip install addict einops omegaconf pyyaml safetensors",
            allow_module_level=True,
        )


def random_network():
    """DA3-SMALL with random weights whose cameras are plausible: about 57 degrees wide, upright."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # upstream's own deprecations
        from depth_anything_3.cfg import create_object, load_config
        from depth_anything_3.registry import MODEL_REGISTRY

        torch.manual_seed(0)
        network = create_object(load_config(MODEL_REGISTRY["da3-small"]))
    with torch.no_grad():
        network.cam_dec.fc_fov[0].bias.fill_(1.0)
        network.cam_dec.fc_qvec.bias.copy_(torch.tensor([0.1, -0.2, 0.3, 1.0]))
        # Without training all images look alike to the camera decoder: let it see more of a difference.
        network.cam_dec.fc_t.weight.mul_(30.0)
    return network.eval()


@pytest.fixture(scope="module")
def network():
    return random_network()


@pytest.fixture(scope="module")
def backbone(network, tmp_path_factory: pytest.TempPathFactory):
    from safetensors.torch import save_model

    path = tmp_path_factory.mktemp("da3") / "model.safetensors"
    save_model(torch.nn.ModuleDict({"model": network}), str(path))  # as the released files: prefix, tied tensors once
    backbone = create_backbone(BackboneOptions(backbone="da3", weights=str(path), device="cpu", threads=1))
    backbone.longest_px = 98  # the network takes any size; small ones keep the tests short
    return backbone


def photograph(number: int, width: int, height: int) -> WorkingImage:
    rng = np.random.default_rng(number)
    coarse = rng.integers(0, 255, (height // 20 + 1, width // 20 + 1, 3), dtype=np.uint8)
    rgb = np.repeat(np.repeat(coarse, 20, axis=0), 20, axis=1)[:height, :width]
    shot = Shot(f"{number}.jpg", Path(f"{number}.jpg"), 10 * width, 10 * height, "k", 0.8, 0.05, "guess")
    rows, columns = rgb.shape[:2]
    return WorkingImage(shot, rgb, PixelMap(columns / shot.width_px, rows / shot.height_px))


SAME = dict.fromkeys(range(4), (401, 303))
MIXED = {0: (401, 303), 1: (303, 401), 2: (355, 201), 3: (401, 303)}


def run(backbone, sizes: dict[int, tuple[int, int]], order: tuple[int, ...]) -> LocalModel:
    images = {number: photograph(number, *size) for number, size in sizes.items()}
    model = backbone.reconstruct(Subset(order[:2], order[2:]), images, {})
    assert isinstance(model, LocalModel)
    return model


@pytest.fixture(scope="module", params=[SAME, MIXED], ids=["odd size", "mixed"])
def model(request: pytest.FixtureRequest, backbone) -> LocalModel:
    return run(backbone, request.param, (0, 1, 2, 3))


def test_points_project_back_to_their_own_pixels(model: LocalModel) -> None:
    assert set(model.views) == {0, 1, 2, 3}
    for view in model.views.values():
        pixels = view.camera.project(view.local_from_cam.inverse().apply(view.points.astype(float)))
        assert np.abs(pixels - view.camera.pixel_centres()).max() < 0.02


def test_cameras_orthonormal_confidence_in_range_tokens_differ(model: LocalModel) -> None:
    for view in model.views.values():
        rotation = view.local_from_cam.rotation
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12
        assert view.confidence.min() >= 0.0
        assert view.confidence.max() <= 1.0
        assert view.tokens.shape == (768,)
    assert len({view.tokens.tobytes() for view in model.views.values()}) == 4
    assert not model.metric


def test_same_numbers_as_the_network_itself(backbone, network) -> None:
    images = {number: photograph(number, *size) for number, size in SAME.items()}
    rgb = torch.from_numpy(compose([backbone.prepare(image) for image in images.values()]).rgb)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    with torch.inference_mode():
        answer = network(((rgb - mean) / std).permute(0, 3, 1, 2)[None])
    model = backbone.reconstruct(Subset((0, 1), (2, 3)), images, {})
    for number, view in model.views.items():
        cam_from_local = view.local_from_cam.inverse().matrix()
        assert np.abs(cam_from_local[:3] - answer["extrinsics"][0, number, :3].numpy()).max() < 1e-3
        assert np.abs(view.camera.matrix() - answer["intrinsics"][0, number].numpy()).max() < 1e-2
        depth = view.local_from_cam.inverse().apply(view.points.astype(float))[..., 2]
        assert np.abs(depth / answer["depth"][0, number].numpy() - 1.0).max() < 1e-4
        raw = answer["depth_conf"][0, number].numpy()
        assert np.abs(view.confidence - (1.0 - 1.0 / raw)).max() < 1e-5
        assert np.all(np.diff(view.confidence.ravel()[np.argsort(raw.ravel())]) >= -1e-6)


def test_order_of_the_images_permutes_the_answers(backbone) -> None:
    # From three images on the network chooses the frame itself (by content), so that poses may be compared too.
    straight, turned = run(backbone, SAME, (0, 1, 2, 3)), run(backbone, SAME, (2, 0, 3, 1))
    for number, view in straight.views.items():
        other = turned.views[number]
        assert np.abs(view.confidence - other.confidence).max() < 1e-4
        assert np.abs(view.points - other.points).max() < 1e-3 * np.abs(view.points).max()
        assert np.abs(view.tokens - other.tokens).max() < 1e-3 * np.abs(view.tokens).max()


def test_weights_of_a_single_image_model_are_refused(network, tmp_path: Path) -> None:
    state = {key: value for key, value in network.state_dict().items() if not key.startswith("cam_dec")}
    torch.save(state, tmp_path / "mono.pt")
    with pytest.raises(OptionError, match="not an any-view model"):
        create_backbone(BackboneOptions(backbone="da3", weights=str(tmp_path / "mono.pt"), device="cpu"))


def test_weights_with_a_missing_tensor_are_refused(network, tmp_path: Path) -> None:
    state = {key: value for key, value in network.state_dict().items() if key != "cam_dec.fc_fov.0.bias"}
    torch.save(state, tmp_path / "short.pt")
    with pytest.raises(OptionError, match=r"1 missing \(cam_dec\.fc_fov\.0\.bias\); 0 unexpected"):
        create_backbone(BackboneOptions(backbone="da3", weights=str(tmp_path / "short.pt"), device="cpu"))
