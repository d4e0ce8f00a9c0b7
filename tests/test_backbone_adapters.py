"""Contract of the neural adapters on fakes that emit the documented outputs in each model's own conventions."""

from __future__ import annotations

import importlib.machinery
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones.registry import create_backbone, load_backbone
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.geometry.transforms import Rigid3, rotation_angle_deg, rotation_exp
from onthefly3r.intake.folder import read_photographs
from onthefly3r.intake.images import load_working_image
from onthefly3r.options import BackboneOptions, IntakeOptions
from onthefly3r.records import LocalModel, Shot, Subset, WorkingImage

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")
NAMES = ("pi3", "pi3x", "vggt", "vggt-omega", "mapanything")


class Truth:
    """What image number k shows; networks know k from the colour of the image's middle."""

    def __init__(self, number: int, height: int, width: int) -> None:
        self.fov_w = 0.9 + 0.03 * number
        self.fov_h = 0.7 + 0.02 * number
        self.fx = 0.5 * width / np.tan(0.5 * self.fov_w)
        self.fy = 0.5 * height / np.tan(0.5 * self.fov_h)
        self.world_from_cam = Rigid3(
            rotation_exp(np.array([0.1 * number, 0.2, -0.05 * number])), np.array([number, 2.0, -1.0])
        )
        row, column = np.mgrid[:height, :width].astype(float)
        self.depth = 5.0 + number + 0.5 * np.sin(column / 20.0) + 0.3 * np.cos(row / 15.0)
        self.logit = 4.0 * np.sin(column / 30.0 + number)
        # Pixels counted from centre to centre, as the networks do: the middle is (W - 1) / 2.
        x = (column - 0.5 * (width - 1)) / self.fx * self.depth
        y = (row - 0.5 * (height - 1)) / self.fy * self.depth
        self.points_cam = np.stack([x, y, self.depth], axis=-1)
        self.token = float(number)

    def pose_encoding(self) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        inverse = self.world_from_cam.inverse()
        quaternion = Rotation.from_matrix(inverse.rotation).as_quat()
        return np.concatenate([inverse.translation, quaternion, [self.fov_h, self.fov_w]])


def truths(images: torch.Tensor) -> list[Truth]:
    """The truths of images (S, 3, H, W) in 0..1."""
    height, width = images.shape[-2:]
    middle = images[:, 0, height // 2, width // 2]
    return [Truth(round(float(value) * 255.0 / 20.0), height, width) for value in middle]


def stacked(values: list[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.stack(values)).float()[None]


class FakePi3(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.decoder = torch.nn.ModuleList([torch.nn.Identity()])
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        true = truths(images[0])
        tokens = torch.stack([torch.full((9, 16), t.token) for t in true])  # 5 registers, 4 patches
        tokens[:, 5:] = 99.0
        self.decoder[-1](tokens.reshape(1, -1, 16))  # the last block joins all images
        return {
            "camera_poses": stacked([t.world_from_cam.matrix() for t in true]),
            "local_points": stacked([t.points_cam for t in true]),
            "conf": stacked([t.logit[..., None] for t in true]),
        }


class FakePi3X(FakePi3):
    def __init__(self, use_multimodal: bool = True) -> None:
        super().__init__()
        assert not use_multimodal

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        return {**super().forward(images), "metric": torch.ones(1)}


class FakeAggregator(torch.nn.Module):
    def forward(self, true: list[Truth]) -> tuple[list[torch.Tensor], int]:
        tokens = torch.stack([torch.full((9, 16), t.token) for t in true])[None]
        tokens[:, :, 0] = tokens[:, :, 5:9] = 99.0  # camera, then 4 registers, then patches
        return [torch.zeros(1), tokens], 5


class FakeVggt(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.aggregator = FakeAggregator()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        true = truths(images[0])
        self.aggregator(true)
        return {
            "pose_enc": stacked([t.pose_encoding() for t in true]),
            "depth": stacked([t.depth[..., None] for t in true]),
            "depth_conf": stacked([1.0 + np.exp(t.logit) for t in true]),
        }


class FakeOmega(FakeVggt):
    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        true = truths(images[0])
        tokens = torch.stack([torch.full((17, 16), t.token) for t in true])[None]
        tokens[:, :, 0] = 99.0
        return {**super().forward(images), "camera_and_register_tokens": tokens}


class FakeInfoSharing(torch.nn.Module):
    def forward(self, true: list[Truth]) -> object:
        per_view = [torch.full((1, 16, 1), t.token) for t in true]
        return types.SimpleNamespace(additional_token_features_per_view=per_view), []


class FakeMapAnything(torch.nn.Module):
    def __init__(self, **config: object) -> None:
        super().__init__()
        assert config["encoder_config"] == {"size": "giant", "torch_hub_pretrained": False}
        self.info_sharing = FakeInfoSharing()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def infer(self, views: list[dict], use_amp: bool, apply_mask: bool) -> list[dict]:
        mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
        assert all(view["data_norm_type"] == ["dinov2"] for view in views)
        images = torch.cat([view["img"] for view in views]) * std[:, None, None] + mean[:, None, None]
        true = truths(images)
        self.info_sharing(true)
        return [self._answer(t) for t in true]

    @staticmethod
    def _answer(t: Truth) -> dict[str, torch.Tensor]:
        height, width = t.depth.shape
        k = np.array([[t.fx, 0.0, 0.5 * (width - 1)], [0.0, t.fy, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        points = t.points_cam.copy()
        points[:3] = 0.0  # what the mask hides is zero
        mask = np.ones((height, width, 1), bool)
        mask[:3] = False
        answer = {
            "camera_poses": t.world_from_cam.matrix(),
            "pts3d_cam": points,
            "intrinsics": k,
            "conf": 1.0 + np.exp(t.logit),
            "mask": mask,
        }
        return {key: torch.from_numpy(value)[None] for key, value in answer.items()}


FAKES = {
    "pi3": ("pi3.models.pi3", {"Pi3": FakePi3}),
    "pi3x": ("pi3.models.pi3x", {"Pi3X": FakePi3X}),
    "vggt": ("vggt.models.vggt", {"VGGT": FakeVggt}),
    "vggt-omega": ("vggt_omega.models", {"VGGTOmega": FakeOmega}),
    "mapanything": ("mapanything.models", {"MapAnything": FakeMapAnything}),
}


@pytest.fixture
def backbone(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """The adapter of the parametrised name over its fake upstream package and a weights file."""
    name = request.param
    module, attributes = FAKES[name]
    parts = module.split(".")
    packages = [".".join(parts[: n + 1]) for n in range(len(parts))]
    for package in [*packages, "huggingface_hub", "uniception", "torchvision", "hydra"]:
        fake = types.ModuleType(package)
        fake.__spec__ = importlib.machinery.ModuleSpec(package, None)
        monkeypatch.setitem(sys.modules, package, fake)
    for key, value in attributes.items():
        setattr(sys.modules[module], key, value)
    torch.save({"weight": torch.ones(1)}, tmp_path / "model.pt")
    (tmp_path / "config.json").write_text('{"encoder_config": {"size": "giant"}, "info_sharing_config": {}}')
    return create_backbone(BackboneOptions(backbone=name, weights=str(tmp_path), device="cpu"))


every_adapter = pytest.mark.parametrize("backbone", NAMES, indirect=True)


def photograph(number: int, width: int, height: int, rgb: np.ndarray | None = None) -> WorkingImage:
    """A photograph of width x height whose working image is smaller and rounded, as intake makes them."""
    scale = 600 / max(width, height)
    columns, rows = round(width * scale), round(height * scale)
    pixels = np.full((rows, columns, 3), 20 * number, np.uint8) if rgb is None else rgb
    name = f"{number}.jpg"
    shot = Shot(name, Path(name), width, height, f"{width}x{height}", 0.8, 0.05, "guess")
    return WorkingImage(shot, pixels, PixelMap(columns / width, rows / height))


def run(backbone, sizes: dict[int, tuple[int, int]], order: tuple[int, ...] | None = None) -> LocalModel:
    images = {number: photograph(number, *size) for number, size in sizes.items()}
    order = order or tuple(sizes)
    model = backbone.reconstruct(Subset(order[:2], order[2:]), images, {})
    assert isinstance(model, LocalModel)
    return model


SAME = dict.fromkeys((1, 2, 3, 4), (4001, 2999))
MIXED = {1: (4001, 2999), 2: (2999, 4001), 3: (1777, 1000), 4: (1001, 1001)}


@every_adapter
@pytest.mark.parametrize("sizes", [SAME, MIXED], ids=["odd size", "mixed sizes and orientations"])
def test_points_project_back_to_their_own_pixels(backbone, sizes) -> None:
    model = run(backbone, sizes)
    assert set(model.views) == set(sizes)
    for view in model.views.values():
        rows, columns = view.points.shape[:2]
        assert (view.camera.height, view.camera.width) == (rows, columns) == view.confidence.shape
        assert view.points.dtype == view.confidence.dtype == np.float32
        pixels = view.camera.project(view.local_from_cam.inverse().apply(view.points.astype(float)))
        known = np.isfinite(view.points).all(axis=-1)
        assert known.mean() > 0.95
        assert np.abs(pixels - view.camera.pixel_centres())[known].max() < 0.02
        assert np.all(view.confidence[~known] == 0.0)


@every_adapter
def test_cameras_are_the_true_ones_and_orthonormal(backbone) -> None:
    for number, view in run(backbone, SAME).views.items():
        true = Truth(number, view.camera.height, view.camera.width)
        rotation = view.local_from_cam.rotation
        assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12
        assert np.linalg.det(rotation) > 0.0
        assert rotation_angle_deg(rotation.T @ true.world_from_cam.rotation) < 1e-3
        assert np.abs(view.local_from_cam.translation - true.world_from_cam.translation).max() < 1e-4
        assert (view.camera.fx, view.camera.fy) == pytest.approx((true.fx, true.fy), rel=1e-4)
        centre = (0.5 * view.camera.width, 0.5 * view.camera.height)
        assert (view.camera.cx, view.camera.cy) == pytest.approx(centre, abs=1e-3)


@every_adapter
def test_confidence_is_the_logistic_function_of_the_raw_one(backbone) -> None:
    for number, view in run(backbone, SAME).views.items():
        true = Truth(number, view.camera.height, view.camera.width)
        known = np.isfinite(view.points).all(axis=-1)
        assert view.confidence.min() >= 0.0
        assert view.confidence.max() <= 1.0
        assert np.abs(view.confidence[known] - 1.0 / (1.0 + np.exp(-true.logit[known]))).max() < 1e-5
        order = np.argsort(true.logit[known])
        assert np.all(np.diff(view.confidence[known][order]) >= -1e-6)


@every_adapter
def test_one_token_an_image_without_camera_and_patch_tokens(backbone) -> None:
    assert backbone.spec.has_tokens
    for number, view in run(backbone, SAME).views.items():
        assert view.tokens is not None
        assert view.tokens == pytest.approx(np.full(16, number))


@every_adapter
def test_order_of_the_images_does_not_matter(backbone) -> None:
    straight, turned = run(backbone, MIXED), run(backbone, MIXED, (3, 1, 4, 2))
    for number, view in straight.views.items():
        other = turned.views[number]
        assert other.camera == view.camera
        assert other.grid_from_photo == view.grid_from_photo
        for field in ("points", "confidence", "tokens"):
            assert np.array_equal(getattr(other, field), getattr(view, field), equal_nan=True)


@every_adapter
def test_calibrations_of_new_cameras_at_photograph_size(backbone) -> None:
    model = run(backbone, SAME)
    (camera,) = model.calibrations.values()
    assert (camera.width, camera.height) == SAME[1]
    view = model.views[1]
    through = view.camera.through(view.grid_from_photo.inverse(), camera.width, camera.height)
    assert camera.fx == pytest.approx(through.fx, rel=0.1)
    again = backbone.reconstruct(
        Subset((1, 2), (3,)), {n: photograph(n, *s) for n, s in SAME.items()}, model.calibrations
    )
    assert again.calibrations == {}


@every_adapter
def test_metric_models_say_so(backbone) -> None:
    assert run(backbone, SAME).metric == (backbone.spec.name in ("pi3x", "mapanything"))


def dotted(width: int, height: int, x: float, y: float) -> np.ndarray:
    """A working image (longest side 600) with a soft white dot at a photograph's pixel coordinates."""
    scale = 600 / max(width, height)
    columns, rows = round(width * scale), round(height * scale)
    u, v = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    value = 255.0 * np.exp(-((u - x * columns / width) ** 2 + (v - y * rows / height) ** 2) / (2 * 5.0**2))
    return np.repeat(value.round().astype(np.uint8)[..., None], 3, axis=2)


@pytest.fixture(params=[*NAMES, "da3"])
def adapter(request: pytest.FixtureRequest):
    """An adapter that only prepares photographs: that part needs neither upstream code nor weights."""
    made = load_backbone(request.param)
    assert isinstance(made, type)
    return object.__new__(made)


def centre_of_light(rgb: np.ndarray) -> tuple[float, float]:
    """The centroid (x, y) of the brightness above black."""
    weight = np.clip(rgb[..., 0].astype(float) - 20.0, 0.0, None)  # JPEG leaves black a little grey
    rows, columns = weight.shape
    x = (weight.sum(axis=0) * (np.arange(columns) + 0.5)).sum() / weight.sum()
    y = (weight.sum(axis=1) * (np.arange(rows) + 0.5)).sum() / weight.sum()
    return float(x), float(y)


@pytest.mark.parametrize("size", [(4000, 3000), (3001, 3999), (4000, 1501), (999, 2001), (640, 640)], ids=str)
def test_grid_from_photo_follows_resizing_and_crops(adapter, size) -> None:
    width, height = size
    x, y = 0.45 * width, 0.56 * height
    network = adapter.prepare(photograph(1, width, height, dotted(width, height, x, y)))
    assert centre_of_light(network.rgb) == pytest.approx(network.grid_from_photo.apply(np.array([x, y])), abs=0.05)


# EXIF orientation -> how an upright image is stored.
STORED = {
    1: lambda image: image,
    3: lambda image: np.rot90(image, 2),
    6: lambda image: np.rot90(image, 1),
    8: lambda image: np.rot90(image, 3),
    5: lambda image: np.swapaxes(image, 0, 1),
}


@pytest.mark.parametrize("orientation", STORED)
def test_exif_rotated_photographs_reach_the_network_upright(adapter, orientation: int, tmp_path: Path) -> None:
    from PIL import Image

    upright = dotted(600, 450, 200.0, 300.0)[:449, :599]
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = Image.fromarray(np.ascontiguousarray(STORED[orientation](upright)))
    stored.save(tmp_path / "a.jpg", quality=95, exif=exif)
    (shot,), refused = read_photographs(tmp_path, IntakeOptions())
    assert not refused
    assert (shot.width_px, shot.height_px) == (599, 449)
    network = adapter.prepare(load_working_image(shot, 500))
    there = network.grid_from_photo.apply(np.array([200.0, 300.0]))
    assert centre_of_light(network.rgb) == pytest.approx(there, abs=0.3)


EXPECTED_SIZES = {
    "pi3": {(6000, 4000): (616, 406), (4000, 3000): (574, 434), (3000, 4000): (434, 574)},
    "pi3x": {(6000, 4000): (616, 406)},
    "vggt": {(6000, 4000): (518, 350), (4000, 3000): (518, 392), (3000, 4000): (518, 518)},
    "vggt-omega": {(6000, 4000): (624, 416), (4000, 1000): (720, 368), (3000, 4000): (448, 592)},
    "mapanything": {(6000, 4000): (518, 336), (4000, 3000): (518, 392), (3000, 4000): (392, 518)},
    "da3": {(6000, 4000): (504, 336), (6020, 4510): (504, 378), (4510, 6020): (378, 504)},
}


def test_sizes_are_those_the_models_were_trained_at(adapter) -> None:
    for (width, height), expected in EXPECTED_SIZES[adapter.card.name].items():
        network = adapter.prepare(photograph(1, width, height))
        assert network.rgb.shape[1::-1] == expected


@pytest.mark.parametrize("backbone", ["vggt"], indirect=True)
def test_a_view_without_a_field_of_view_is_left_out(backbone, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = Truth.pose_encoding

    def shut(self: Truth) -> np.ndarray:
        encoding = encode(self)
        if self.token == 3.0:
            encoding[8] = 0.0  # the network's ReLU let nothing through: an infinite focal length
        return encoding

    monkeypatch.setattr(Truth, "pose_encoding", shut)
    assert set(run(backbone, SAME).views) == {1, 2, 4}
