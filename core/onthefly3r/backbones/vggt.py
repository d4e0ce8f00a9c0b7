"""VGGT and VGGT-Omega (facebookresearch): z-depth, pose encoding local -> camera, 1 + exp confidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..networks.torch_tools import captured, to_numpy
from ..records import WorkingImage
from .conventions import (
    NetworkImage,
    Prediction,
    centred_box,
    confidence_from_one_plus_exp,
    decode_pose,
    network_image,
    rigid_inverse,
    unproject,
)
from .torch_runtime import ModelCard, TorchBackbone

INSTALL = "pip install --no-deps git+https://github.com/facebookresearch"


def prediction(answer: Mapping[str, Any], tokens: Any) -> Prediction:
    """Convert `pose_enc`, `depth` and `depth_conf` of a batch of one; unprojected depth beats the point head."""
    depth = to_numpy(answer["depth"][0])
    depth = depth[..., 0] if depth.ndim == 4 else depth
    cam_from_local, intrinsics = decode_pose(to_numpy(answer["pose_enc"][0]), *depth.shape[1:])
    return Prediction(
        local_from_cam=rigid_inverse(cam_from_local),
        points_cam=unproject(depth, intrinsics),
        confidence=confidence_from_one_plus_exp(to_numpy(answer["depth_conf"][0])),
        intrinsics=intrinsics,
        tokens=to_numpy(tokens.float().mean(dim=1)),
    )


class Vggt(TorchBackbone):
    """VGGT-1B: the first image of a subset is the frame of the local model."""

    card = ModelCard(
        name="vggt",
        module="vggt",
        install=f"{INSTALL}/vggt; pip install einops huggingface_hub",
        code_licence="VGGT licence (Meta)",
        weights_licence="VGGT-1B non-commercial; VGGT-1B-Commercial on request",
        weights_source="Download model.safetensors or model.pt of https://huggingface.co/facebook/VGGT-1B.",
        confidence_threshold=0.5,
        memory_gib=3.6,
        needs=("huggingface_hub",),
    )
    side_px = 518
    patch_px = 14

    def prepare(self, image: WorkingImage) -> NetworkImage:
        """Resize to width 518 with the height in whole patches, and crop the height to 518 about the centre."""
        rows, columns = image.rgb.shape[:2]
        height = max(1, round(rows * self.side_px / columns / self.patch_px)) * self.patch_px
        if height <= self.side_px:
            return network_image(image, self.side_px, height, "BICUBIC")
        top = (height - self.side_px) // 2 * rows / height
        box = (0.0, top, float(columns), top + self.side_px * rows / height)
        return network_image(image, self.side_px, self.side_px, "BICUBIC", box)

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Build the network."""
        from vggt.models.vggt import VGGT

        return VGGT(), state

    def predict(self, network: Any, images: Any) -> Prediction:
        """Run it; the token of an image is the mean of its four register tokens."""
        with captured(network.aggregator, lambda output: output[0][-1][0, :, 1:5]) as tokens:
            answer = network(images)
        return prediction(answer, tokens[-1])


class VggtOmega(TorchBackbone):
    """VGGT-Omega at 512: like VGGT without a point head, 16 register tokens."""

    card = ModelCard(
        name="vggt-omega",
        module="vggt_omega",
        install=f"{INSTALL}/vggt-omega; pip install einops",
        code_licence="FAIR non-commercial research licence",
        weights_licence="FAIR non-commercial research licence, outputs too; gated",
        weights_source="Ask for vggt_omega_1b_512.pt at https://huggingface.co/facebook/VGGT-Omega and download it.",
        confidence_threshold=0.5,
        memory_gib=6.7,
        weights_files=("vggt_omega_1b_512.pt", "model.safetensors", "model.pt"),
    )
    tokens_per_image = 32 * 32
    patch_px = 16

    def prepare(self, image: WorkingImage) -> NetworkImage:
        """Crop to an aspect within 1:2 and 2:1, then spread 32 x 32 patches over it."""
        rows, columns = image.rgb.shape[:2]
        aspect = min(max(columns / rows, 0.5), 2.0)
        across = round((self.tokens_per_image * aspect) ** 0.5)
        down = round((self.tokens_per_image / aspect) ** 0.5)
        size = (across * self.patch_px, down * self.patch_px)
        return network_image(image, *size, "BICUBIC", centred_box(image, aspect))

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Build the network; its `bias_mask` buffers are NaN until loaded, which the strict load checks."""
        from vggt_omega.models import VGGTOmega

        return VGGTOmega(), state

    def predict(self, network: Any, images: Any) -> Prediction:
        """Run it; the token of an image is the mean of its 16 register tokens."""
        answer = network(images)
        return prediction(answer, answer["camera_and_register_tokens"][0, :, 1:])
