"""Pi3 and Pi3X (yyfz/Pi3): permutation-equivariant local point maps, poses camera -> world, logit confidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..networks.torch_tools import captured, to_numpy
from ..records import WorkingImage
from .conventions import NetworkImage, Prediction, confidence_from_logit, network_image
from .torch_runtime import ModelCard, TorchBackbone

MAX_AREA_PX = 255_000
PATCH_PX = 14
REGISTERS = 5
INSTALL = "git clone https://github.com/yyfz/Pi3, put that folder on PYTHONPATH; pip install einops huggingface_hub"


def network_size(width: int, height: int) -> tuple[int, int]:
    """Return the (width, height) in whole patches nearest to the aspect within the area the model was trained at."""
    scale = (MAX_AREA_PX / (width * height)) ** 0.5
    columns, rows = round(width * scale / PATCH_PX), round(height * scale / PATCH_PX)
    while columns * rows * PATCH_PX**2 > MAX_AREA_PX:
        if columns * height > rows * width:
            columns -= 1
        else:
            rows -= 1
    return max(1, columns) * PATCH_PX, max(1, rows) * PATCH_PX


class Pi3(TorchBackbone):
    """Pi3: arbitrary scale; intrinsics are fitted to the point maps."""

    card = ModelCard(
        name="pi3",
        module="pi3",
        install=INSTALL,
        code_licence="BSD-3-Clause",
        weights_licence="CC BY-NC 4.0 (no commercial use)",
        weights_source="Download model.safetensors of https://huggingface.co/yyfz233/Pi3.",
        confidence_threshold=0.5,
        needs=("huggingface_hub",),
    )

    def prepare(self, image: WorkingImage) -> NetworkImage:
        """Resize to at most 255,000 px, both sides in whole patches, without a crop."""
        return network_image(image, *network_size(image.shot.width_px, image.shot.height_px), "LANCZOS")

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Build the network."""
        from pi3.models.pi3 import Pi3 as Network

        return Network(), state

    def predict(self, network: Any, images: Any) -> Prediction:
        """Run it; the token of an image is the mean of its register tokens in the last decoder block."""
        count = images.shape[1]
        with captured(network.decoder[-1], lambda output: output) as tokens:
            answer = network(images)
        registers = tokens[-1].reshape(count, -1, tokens[-1].shape[-1])[:, :REGISTERS]
        return Prediction(
            local_from_cam=to_numpy(answer["camera_poses"][0]),
            points_cam=to_numpy(answer["local_points"][0]),
            confidence=confidence_from_logit(to_numpy(answer["conf"][0, ..., 0])),
            intrinsics=None,
            tokens=to_numpy(registers.float().mean(dim=1)),
            metric="metric" in answer,
        )


class Pi3X(Pi3):
    """Pi3X without conditions: metric scale, the parts that take poses, depths and rays are not built."""

    card = ModelCard(
        name="pi3x",
        module="pi3",
        install=INSTALL,
        code_licence="BSD-3-Clause",
        weights_licence="CC BY-NC 4.0 (no commercial use)",
        weights_source="Download model.safetensors of https://huggingface.co/yyfz233/Pi3X.",
        confidence_threshold=0.1,
        memory_gib=4.2,
        needs=("huggingface_hub",),
    )
    spare_weights = ("depth_encoder", "depth_emb", "ray_embed", "pose_inject_blk")

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Build the network for photographs alone."""
        from pi3.models.pi3x import Pi3X as Network

        return Network(use_multimodal=False), state
