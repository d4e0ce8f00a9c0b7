"""Pixels of a shot at working size: upright RGB, reduced while decoding where the format allows it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import PhotographError
from ..geometry.camera import PixelMap
from ..records import Shot, WorkingImage
from .opening import opened

if TYPE_CHECKING:
    from PIL.Image import Image

# EXIF orientation -> how the stored image is turned upright.
_UPRIGHT = {
    2: "FLIP_LEFT_RIGHT",
    3: "ROTATE_180",
    4: "FLIP_TOP_BOTTOM",
    5: "TRANSPOSE",
    6: "ROTATE_270",
    7: "TRANSVERSE",
    8: "ROTATE_90",
}


def load_working_image(shot: Shot, working_px: int) -> WorkingImage:
    """Return the upright RGB image whose longest side is at most `working_px`; never enlarged.

    Safe to call from several threads. Raises `PhotographError` for truncated or damaged pixels.
    """
    with opened(shot.path, shot.name) as image:
        try:
            reduced = _reduce(image, working_px)
        except Exception as error:  # decoders fail in many ways on damaged data
            raise PhotographError(shot.name, f"pixels cannot be decoded ({error})") from error
    if shot.orientation in _UPRIGHT:
        from PIL.Image import Transpose

        reduced = reduced.transpose(Transpose[_UPRIGHT[shot.orientation]])
    rgb = np.array(reduced, dtype=np.uint8)
    height, width = rgb.shape[:2]
    return WorkingImage(shot, rgb, PixelMap(width / shot.width_px, height / shot.height_px))


def _reduce(image: Image, working_px: int) -> Image:
    from PIL.Image import Resampling

    full_width, full_height = image.size
    factor = min(1.0, working_px / max(full_width, full_height))
    size = max(1, round(full_width * factor)), max(1, round(full_height * factor))
    # JPEG's DCT scaling (1/2, 1/4, 1/8) decodes only what is needed; its last row and column may be partly empty.
    drafted = image.draft("RGB", size)
    box = drafted[1] if drafted else (0, 0, full_width, full_height)
    rgb = _to_rgb(image)
    if size == (full_width, full_height):
        return rgb
    return rgb.resize(size, Resampling.LANCZOS, box=box)


def _to_rgb(image: Image) -> Image:
    from PIL.Image import fromarray

    if image.mode.startswith("I"):  # 16-bit grey: the upper byte
        grey = np.asarray(image).astype(np.int64)
        return fromarray(np.clip(grey >> 8, 0, 255).astype(np.uint8)).convert("RGB")
    if image.mode in ("P", "PA"):
        image = image.convert("RGBA")
    return image.convert("RGB")
