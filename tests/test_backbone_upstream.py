"""VGGT-Omega's adapter against its own upstream classes, small and with random weights, where they are installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones.conventions import compose, local_views
from onthefly3r.backbones.vggt import VggtOmega
from onthefly3r.errors import OptionError
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.networks.weights import load_strict
from onthefly3r.records import Shot, WorkingImage

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")
upstream = pytest.importorskip("vggt_omega.models", reason="vggt_omega is not installed (see docs/backbones.md)")


def random_network(bias_mask: float):
    torch.manual_seed(0)
    network = upstream.VGGTOmega(embed_dim=256).eval().requires_grad_(False)
    for name, value in network.named_parameters():
        if value.dim() > 1:
            torch.nn.init.normal_(value, std=0.02)
        else:
            value.fill_(1.0 if "norm" in name and name.endswith("weight") else 0.05)
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
    network = random_network(float("nan"))
    with pytest.raises(OptionError, match="bias_mask"):
        load_strict(network, dict(network.state_dict()), "x.pt")


@pytest.mark.filterwarnings("ignore")  # upstream asks for CUDA's autocast on any machine
def test_cameras_depth_and_tokens_are_those_upstream_decodes() -> None:
    from vggt_omega.utils.pose_enc import encoding_to_camera

    network = random_network(0.0)
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
