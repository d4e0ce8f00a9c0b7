"""EfficientNet-Lite0 up to its last feature map, under the names of its published weights.

Tan and Le, "EfficientNet" (2019), Lite variant: no squeeze-and-excitation, ReLU6, "same" padding as TensorFlow
counts it, batch normalisation with epsilon 0.001.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

STEM_CHANNELS, HEAD_CHANNELS = 32, 1280
# Stages: blocks, kernel, stride of the first block, expansion, channels.
STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)


def features(state: Mapping[str, Any], images: Any) -> Any:
    """Return the feature map (B, 1280, h, w) of images (B, 3, H, W) = (RGB - 127) / 128."""
    from torch.nn import functional

    x = functional.relu6(_normalise(state, "_bn0", _convolve(state, "_conv_stem", images, 2)))
    number, channels = 0, STEM_CHANNELS
    for blocks, _, first_stride, expansion, out_channels in STAGES:
        for position in range(blocks):
            stride = first_stride if position == 0 else 1
            y = _block(state, f"_blocks.{number}.", x, stride, expansion)
            x = x + y if stride == 1 and channels == out_channels else y
            number, channels = number + 1, out_channels
    return functional.relu6(_normalise(state, "_bn1", _convolve(state, "_conv_head", x, 1)))


def expected_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights that `features` uses, by name."""
    shapes: dict[str, tuple[int, ...]] = {"_conv_stem.weight": (STEM_CHANNELS, 3, 3, 3)}
    shapes.update(_norm_shapes("_bn0", STEM_CHANNELS))
    number, channels = 0, STEM_CHANNELS
    for blocks, kernel, _, expansion, out_channels in STAGES:
        for _ in range(blocks):
            name, wide = f"_blocks.{number}.", channels * expansion
            if expansion > 1:
                shapes[name + "_expand_conv.weight"] = (wide, channels, 1, 1)
                shapes.update(_norm_shapes(name + "_bn0", wide))
            shapes[name + "_depthwise_conv.weight"] = (wide, 1, kernel, kernel)
            shapes.update(_norm_shapes(name + "_bn1", wide))
            shapes[name + "_project_conv.weight"] = (out_channels, wide, 1, 1)
            shapes.update(_norm_shapes(name + "_bn2", out_channels))
            number, channels = number + 1, out_channels
    shapes["_conv_head.weight"] = (HEAD_CHANNELS, channels, 1, 1)
    shapes.update(_norm_shapes("_bn1", HEAD_CHANNELS))
    return shapes


def _norm_shapes(name: str, channels: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.{part}": (channels,) for part in ("weight", "bias", "running_mean", "running_var")}


def _block(state: Mapping[str, Any], name: str, x: Any, stride: int, expansion: int) -> Any:
    from torch.nn import functional

    if expansion > 1:
        x = functional.relu6(_normalise(state, name + "_bn0", _convolve(state, name + "_expand_conv", x, 1)))
    depthwise = _convolve(state, name + "_depthwise_conv", x, stride, groups=x.shape[1])
    x = functional.relu6(_normalise(state, name + "_bn1", depthwise))
    return _normalise(state, name + "_bn2", _convolve(state, name + "_project_conv", x, 1))


def _convolve(state: Mapping[str, Any], name: str, x: Any, stride: int, groups: int = 1) -> Any:
    from torch.nn import functional

    weight = state[name + ".weight"]
    padding = []
    for size in (x.shape[-1], x.shape[-2]):
        total = max((-(-size // stride) - 1) * stride + weight.shape[-1] - size, 0)
        padding += [total // 2, total - total // 2]
    return functional.conv2d(functional.pad(x, padding), weight, stride=stride, groups=groups)


def _normalise(state: Mapping[str, Any], name: str, x: Any) -> Any:
    from torch.nn import functional

    mean, variance = state[name + ".running_mean"], state[name + ".running_var"]
    return functional.batch_norm(x, mean, variance, state[name + ".weight"], state[name + ".bias"], eps=1e-3)
