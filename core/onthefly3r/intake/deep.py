"""Photographs with more than 8 bits per channel: stretched to 8 bits over the range that their flight uses.

Thermal and multispectral cameras fill a small part of 16 bits; the upper byte alone would leave a few grey levels.
One range for all photographs of a camera keeps them alike, so that the same ground keeps its grey value.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import PhotographError
from ..geometry.arrays import Float, Int, UInt8
from ..records import Shot
from .opening import opened, quiet, require_memory

if TYPE_CHECKING:
    from PIL.Image import Image

SAMPLED_PHOTOGRAPHS, SAMPLED_PIXELS = 24, 20_000
CUT_PERCENT = 0.2  # at either end: hot chimneys and dead pixels
MARGIN = 0.02  # of the range, for photographs that were not sampled


def is_deep(image: Image) -> bool:
    """Return whether an opened image stores more than 8 bits per channel."""
    return image.mode.startswith("I") or ";16" in _raw_mode(image)


def deep_to_rgb(image: Image, value_range: tuple[float, float] | None) -> Image:
    """Return an opened deep image as 8-bit RGB at its full size, its own range where none is given."""
    from PIL.Image import fromarray

    values = _values(image)
    low, high = value_range or _range([_sample(values)])
    return fromarray(_stretched(values, low, high)).convert("RGB")


def with_common_range(shots: Sequence[Shot], known: Sequence[Shot] = ()) -> list[Shot]:
    """Return the shots, deep ones with the range of values that those of their camera share.

    Args:
        shots: new ones.
        known: of the same flight, whose range holds for the new ones too.
    """
    ranges = {shot.camera_key: shot.value_range for shot in known if shot.value_range is not None}
    waiting: dict[str, list[Shot]] = defaultdict(list)
    for shot in shots:
        if shot.deep and shot.camera_key not in ranges:
            waiting[shot.camera_key].append(shot)
    for key, of_camera in waiting.items():
        chosen = np.unique(np.linspace(0, len(of_camera) - 1, SAMPLED_PHOTOGRAPHS).astype(int))
        samples = [sample for k in chosen if (sample := _sample_of(of_camera[k])) is not None]
        if samples:
            ranges[key] = _range(samples)
    return [
        replace(shot, value_range=ranges[shot.camera_key]) if shot.deep and shot.camera_key in ranges else shot
        for shot in shots
    ]


def _sample_of(shot: Shot) -> Float | None:
    try:
        with quiet(), opened(shot.path, shot.name, pixels=True) as image:
            require_memory(image, shot.name)
            return _sample(_values(image))
    except PhotographError:
        return None  # refused with its reason when it is loaded
    except Exception:  # decoders fail in many ways on damaged data
        return None


def _values(image: Image) -> Int:
    """Return the pixels (H, W) or (H, W, 3) as they are stored."""
    if image.mode.startswith("I"):
        return np.asarray(image)
    import cv2

    # Pillow keeps the upper bytes of 16-bit colour; OpenCV gives both, blue first.
    stream: Any = getattr(image, "fp", None)
    stream.seek(0)
    found = cv2.imdecode(np.frombuffer(stream.read(), np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None or found.dtype != np.uint16 or found.shape[0] * found.shape[1] != image.size[0] * image.size[1]:
        raise ValueError("16-bit colour that OpenCV cannot read")
    return np.asarray(found[..., 2::-1] if found.ndim == 3 else found)


def _sample(values: Int) -> Float:
    step = max(1, round((values.size / SAMPLED_PIXELS) ** 0.5))
    return np.asarray(values[::step, ::step].ravel(), float)


def _range(samples: Sequence[Float]) -> tuple[float, float]:
    low, high = np.percentile(np.concatenate(samples), [CUT_PERCENT, 100.0 - CUT_PERCENT])
    margin = max(MARGIN * (high - low), 0.5)
    return float(low - margin), float(high + margin)


def _stretched(values: Int, low: float, high: float) -> UInt8:
    if values.dtype == np.uint16:  # by a table: no copy in floating point of the whole picture
        levels = (np.arange(65536) - low) * (255.0 / (high - low))
        return np.asarray(np.clip(levels + 0.5, 0, 255).astype(np.uint8)[values])
    rows = np.empty(values.shape, np.uint8)
    for row, line in zip(rows, values, strict=True):
        row[:] = np.clip((line - low) * (255.0 / (high - low)) + 0.5, 0, 255)
    return rows


def _raw_mode(image: Image) -> str:
    """Return how the pixels are stored, "" where Pillow does not tell."""
    tiles = getattr(image, "tile", None) or ()
    arguments = tiles[0][3] if tiles else ""
    found = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return found if isinstance(found, str) else ""
