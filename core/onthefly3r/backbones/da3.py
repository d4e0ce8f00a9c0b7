"""Depth Anything 3 (PyPI depth-anything-3): depth and cameras world -> camera, 1 + exp confidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import OptionError
from ..networks.torch_tools import captured, imagenet_normalised, to_numpy
from ..networks.weights import without_prefix
from ..records import WorkingImage
from .conventions import (
    NetworkImage,
    Prediction,
    confidence_from_one_plus_exp,
    network_image,
    rigid_inverse,
    unproject,
)
from .torch_runtime import ModelCard, TorchBackbone

# The any-view models by the width of their transformer; METRIC and MONO see single images only.
MODELS = {384: "da3-small", 768: "da3-base", 1024: "da3-large", 1536: "da3-giant"}
WIDTH_KEY = "backbone.pretrained.cls_token"


class DepthAnything3(TorchBackbone):
    """Depth Anything 3, any-view models; which one is read off the weights."""

    card = ModelCard(
        name="da3",
        module="depth_anything_3",
        install="pip install --no-deps depth-anything-3==0.1.1; pip install addict einops omegaconf pyyaml",
        code_licence="Apache-2.0",
        weights_licence="SMALL and BASE Apache-2.0; LARGE and GIANT CC BY-NC 4.0 (no commercial use)",
        weights_source="Download model.safetensors of https://huggingface.co/depth-anything/DA3-BASE.",
        confidence_threshold=0.5,
        needs=("addict", "einops", "omegaconf"),
    )
    longest_px = 504
    patch_px = 14

    def prepare(self, image: WorkingImage) -> NetworkImage:
        """Resize the longest side to 504 and each side to the nearest whole number of patches."""
        rows, columns = image.rgb.shape[:2]
        scale = self.longest_px / max(rows, columns)
        width, height = (self._in_patches(round(side * scale)) for side in (columns, rows))
        return network_image(image, width, height, "AREA" if scale < 1.0 else "BICUBIC")

    def _in_patches(self, side_px: int) -> int:
        return max(1, int(side_px / self.patch_px + 0.5)) * self.patch_px

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Build the size of network that the weights belong to."""
        from depth_anything_3.cfg import create_object, load_config
        from depth_anything_3.registry import MODEL_REGISTRY

        state = without_prefix(state, "model.")
        width = state[WIDTH_KEY].shape[-1] if WIDTH_KEY in state else None
        if width not in MODELS or "cam_dec.fc_t.weight" not in state:
            raise OptionError(
                "weights: not an any-view model of Depth Anything 3; take DA3-SMALL, DA3-BASE, DA3-LARGE or DA3-GIANT "
                "(METRIC, MONO and NESTED do not give the cameras of many images)"
            )
        return create_object(load_config(MODEL_REGISTRY[MODELS[width]])), state

    def predict(self, network: Any, images: Any) -> Prediction:
        """Run it; the token of an image is its camera token (there are no registers)."""
        with captured(network.backbone, lambda output: output[0][-1][1][0]) as tokens:
            answer = network(imagenet_normalised(images))
        matrices = to_numpy(answer["intrinsics"][0])
        intrinsics = np.stack([matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 0, 2], matrices[:, 1, 2]], axis=1)
        return Prediction(
            local_from_cam=rigid_inverse(to_numpy(answer["extrinsics"][0])),
            points_cam=unproject(to_numpy(answer["depth"][0]), intrinsics),
            confidence=confidence_from_one_plus_exp(to_numpy(answer["depth_conf"][0])),
            intrinsics=intrinsics,
            tokens=to_numpy(tokens[-1]),
        )
