"""MapAnything (facebookresearch/map-anything): metric points, rays and poses camera -> world, view by view."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import MissingDependencyError, OptionError
from ..networks.torch_tools import captured, imagenet_normalised, to_numpy
from ..records import WorkingImage
from .conventions import (
    NetworkImage,
    Prediction,
    centred_box,
    confidence_from_one_plus_exp,
    network_image,
)
from .torch_runtime import ModelCard, TorchBackbone

# Sizes (width, height) the model was trained at, by the aspect that chooses them.
SIZES = {
    0.486: (252, 518),
    0.567: (294, 518),
    0.649: (336, 518),
    0.757: (392, 518),
    1.0: (518, 518),
    1.321: (518, 392),
    1.542: (518, 336),
    1.762: (518, 294),
    2.056: (518, 252),
    3.083: (518, 168),
}


class MapAnything(TorchBackbone):
    """MapAnything from photographs alone; `config.json` must lie beside its weights."""

    card = ModelCard(
        name="mapanything",
        module="mapanything",
        install="pip install git+https://github.com/facebookresearch/map-anything",
        code_licence="Apache-2.0",
        weights_licence="map-anything CC BY-NC 4.0; map-anything-apache Apache-2.0",
        weights_source="Download model.safetensors and config.json of https://huggingface.co/facebook/map-anything-apache.",
        confidence_threshold=0.5,
        needs=("uniception", "torchvision", "hydra", "huggingface_hub"),
    )

    def prepare(self, image: WorkingImage) -> NetworkImage:
        """Resize and crop about the centre to the trained size whose aspect is nearest."""
        rows, columns = image.rgb.shape[:2]
        width, height = SIZES[min(SIZES, key=lambda aspect: abs(aspect - columns / rows))]
        resample = "LANCZOS" if max(width / columns, height / rows) < 1.0 else "BICUBIC"
        return network_image(image, width, height, resample, centred_box(image, width / height))

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Build the network as its `config.json` says, without fetching any pretrained part."""
        from mapanything.models import MapAnything as Network

        if "encoder_config" not in config:
            raise OptionError("backbone mapanything: config.json is missing beside the weights; download it too")
        arguments = copy.deepcopy(dict(config))
        arguments["pretrained_checkpoint_path"] = None
        arguments["encoder_config"]["torch_hub_pretrained"] = False
        arguments["info_sharing_config"].get("module_args", {}).pop("pretrained_checkpoint_path", None)
        try:
            return Network(**arguments), state
        except (OSError, RuntimeError) as error:  # torch.hub fetches the encoder's code, or has it in its cache
            raise MissingDependencyError(
                "backbone mapanything: the code of its DINOv2 encoder cannot be fetched; online, run once in Python: "
                "import torch; torch.hub.load('facebookresearch/dinov2', 'dinov2_vitg14', pretrained=False)"
            ) from error

    def predict(self, network: Any, images: Any) -> Prediction:
        """Run it; the token of an image is its additional token of the information sharing transformer."""
        normalised = imagenet_normalised(images[0])
        views = [{"img": image[None], "data_norm_type": ["dinov2"]} for image in normalised]
        with captured(network.info_sharing, _tokens) as tokens:
            answer = network.infer(views, use_amp=images.device.type == "cuda", apply_mask=True)
        points = np.stack([to_numpy(view["pts3d_cam"][0]) for view in answer])
        mask = np.stack([to_numpy(view["mask"][0, ..., 0]) for view in answer]) > 0.5
        matrices = np.stack([to_numpy(view["intrinsics"][0]) for view in answer])
        # Upstream counts from centre to centre of the pixels: half a pixel to our corner origin.
        intrinsics = matrices[:, (0, 1, 0, 1), (0, 1, 2, 2)] + (0.0, 0.0, 0.5, 0.5)
        return Prediction(
            local_from_cam=np.stack([to_numpy(view["camera_poses"][0]) for view in answer]),
            points_cam=np.where(mask[..., None], points, np.nan),
            confidence=confidence_from_one_plus_exp(np.stack([to_numpy(view["conf"][0]) for view in answer])),
            intrinsics=intrinsics,
            tokens=None if tokens[-1] is None else to_numpy(tokens[-1]),
            metric=True,
        )


def _tokens(output: Any) -> Any:
    import torch

    final = output[0] if isinstance(output, tuple) else output
    per_view = final.additional_token_features_per_view
    return None if per_view is None else torch.stack([token[0].float().mean(dim=-1) for token in per_view])
