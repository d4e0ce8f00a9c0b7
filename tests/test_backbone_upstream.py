"""Adapters against their own upstream classes, small and with random weights, where these are installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones.conventions import compose, local_views
from onthefly3r.backbones.pi3 import Pi3
from onthefly3r.backbones.vggt import VggtOmega
from onthefly3r.errors import OptionError
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.networks.weights import load_strict
from onthefly3r.records import Shot, WorkingImage

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")


def randomise(network: torch.nn.Module) -> None:
    torch.manual_seed(0)
    for name, value in network.named_parameters():
        if value.dim() > 1:
            torch.nn.init.normal_(value, std=0.02)
        else:
            value.fill_(1.0 if "norm" in name and name.endswith("weight") else 0.05)


def random_omega(bias_mask: float):
    upstream = pytest.importorskip("vggt_omega.models", reason="vggt_omega is not installed (see docs/backbones.md)")
    network = upstream.VGGTOmega(embed_dim=256).eval().requires_grad_(False)
    randomise(network)
    for name, value in network.named_buffers():
        if "bias_mask" in name:
            value.fill_(bias_mask)
    bias = network.camera_head.camera_branch[-1].bias
    bias[3:7] = torch.tensor([0.1, -0.2, 0.3, 1.0])
    bias[7:] = 1.0
    return network


def photograph(number: int) -> WorkingImage:
    rgb = np.random.default_rng(number).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    return WorkingImage(Shot(f"{number}.jpg", Path("a"), 400, 300, "k", 0.8, 0.05, "guess"), rgb, PixelMap())


def test_weights_that_leave_the_bias_masks_open_are_refused() -> None:
    network = random_omega(float("nan"))
    with pytest.raises(OptionError, match="bias_mask"):
        load_strict(network, dict(network.state_dict()), "x.pt")


@pytest.mark.filterwarnings("ignore")  # upstream asks for CUDA's autocast on any machine
def test_cameras_depth_and_tokens_are_those_upstream_decodes() -> None:
    network = random_omega(0.0)
    from vggt_omega.utils.pose_enc import encoding_to_camera

    load_strict(network, dict(network.state_dict()), "x.pt")
    adapter = object.__new__(VggtOmega)
    adapter.tokens_per_image = 64
    canvas = compose([adapter.prepare(photograph(number)) for number in range(3)])
    images = torch.from_numpy(canvas.rgb).permute(0, 3, 1, 2)[None].contiguous()
    with torch.inference_mode():
        views = local_views((0, 1, 2), canvas, adapter.predict(network, images))
        answer = network(images)
    cam_from_world, matrices = encoding_to_camera(answer["pose_enc"], images.shape[-2:])
    for number, view in views.items():
        cam_from_local = view.local_from_cam.inverse()
        assert np.abs(cam_from_local.matrix()[:3] - cam_from_world[0, number].numpy()).max() < 1e-5
        assert np.abs(view.camera.matrix() - matrices[0, number].numpy()).max() < 1e-3
        depth = answer["depth"][0, number, ..., 0].numpy()
        known = depth > 0.0
        assert np.array_equal(np.isfinite(view.points).all(axis=-1), known)
        assert np.abs(cam_from_local.apply(view.points.astype(float))[..., 2] - depth)[known].max() < 1e-5
        assert view.tokens is not None
        registers = answer["camera_and_register_tokens"][0, number, 1:].float().mean(dim=0).numpy()
        assert np.abs(view.tokens - registers).max() < 1e-5
    assert set(views) == {0, 1, 2}


def random_pi3(monkeypatch: pytest.MonkeyPatch):
    """Pi3 with four blocks in its decoder and two in its encoder."""
    for name in ("kaiming_uniform_", "trunc_normal_", "uniform_"):  # of a thousand million values that are dropped
        monkeypatch.setattr(torch.nn.init, name, lambda tensor, *_, **__: tensor)
    upstream = pytest.importorskip("pi3.models.pi3", reason="pi3 is not installed (see docs/backbones.md)")
    network = upstream.Pi3().eval().requires_grad_(False)
    network.decoder, network.encoder.blocks = network.decoder[:4], network.encoder.blocks[:2]
    randomise(network)
    return network


@pytest.mark.filterwarnings("ignore")  # upstream asks for CUDA's autocast on any machine
def test_pi3_points_cameras_confidence_and_tokens_are_upstreams(monkeypatch: pytest.MonkeyPatch) -> None:
    network = random_pi3(monkeypatch)
    adapter = object.__new__(Pi3)
    rng = np.random.default_rng(0)
    rgb = torch.from_numpy(rng.random((1, 3, 3, 70, 98), np.float32))
    with torch.inference_mode():
        answer, found = network(rgb), adapter.predict(network, rgb)
        normalised = (rgb - network.image_mean) / network.image_std
        hidden = network.encoder(normalised.reshape(3, 3, 70, 98), is_training=True)["x_norm_patchtokens"]
        last = network.decode(hidden, 3, 70, 98)[0][..., network.dec_embed_dim :]  # the last two blocks are joined
        turned = adapter.predict(network, rgb[:, [2, 0, 1]])
    in_world = np.einsum("sij,shwj->shwi", found.local_from_cam[:, :3, :3], found.points_cam)
    in_world += found.local_from_cam[:, None, None, :3, 3]
    assert np.abs(in_world - answer["points"][0].numpy()).max() < 1e-4 * np.abs(in_world).max()
    assert np.abs(found.confidence - torch.sigmoid(answer["conf"][0, ..., 0]).numpy()).max() < 1e-6
    assert np.abs(found.tokens - last.reshape(3, -1, network.dec_embed_dim)[:, :5].mean(dim=1).numpy()).max() < 1e-6
    for field in ("points_cam", "confidence", "tokens"):
        here, there = getattr(found, field)[[2, 0, 1]], getattr(turned, field)
        assert np.abs(here - there).max() < 1e-3 * np.abs(here).max()
