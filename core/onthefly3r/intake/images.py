"""Pixels of a shot at working size: upright RGB, reduced while decoding where the format allows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import PhotographError
from ..geometry.camera import PixelMap
from ..options import IntakeOptions
from ..records import Shot, WorkingImage
from .deep import deep_to_rgb
from .metadata import read_shot
from .opening import opened, quiet, require_memory
from .stamp import Patience, settled, stamp_of

if TYPE_CHECKING:
    from PIL.Image import Image

    from .raw import RawImage

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
MEMORY_WAIT_S = 1.0  # another photograph that is being decoded may be done by then
_patience = Patience()


def load_working_image(
    shot: Shot, working_px: int, tell: Callable[[str], None] | None = None, patience: Patience = _patience
) -> WorkingImage:
    """Return the upright RGB image whose longest side is at most `working_px`; never enlarged.

    Safe to call from several threads. A file that cannot be read for a moment is waited for.

    Args:
        shot: of the header pass.
        working_px: longest side.
        tell: told when a photograph had to be waited for, or was written anew with the same tags.
        patience: how long is waited, all photographs together.

    Raises `PhotographError` for truncated or damaged pixels, for a file that is gone or holds another photograph than
    in the header pass, and where memory does not suffice.
    """
    try:
        image, waited = patience.attempt(lambda: _load(shot, working_px, patience))
    except PhotographError:
        raise
    except OSError as error:
        raise PhotographError(shot.name, f"cannot be read any more ({error.strerror or error})") from error
    except MemoryError as error:
        raise PhotographError(shot.name, "there is not enough memory to decode it; close other programs") from error
    if tell is not None and waited:
        tell(f"{shot.name} could not be read for a moment and was waited for")
    if tell is not None and image.shot.stamp != shot.stamp:
        tell(f"{shot.name} was written anew during the run; its tags are the same")
    return image


def _load(shot: Shot, working_px: int, patience: Patience) -> WorkingImage:
    shot = _unchanged(shot, patience)
    try:
        return _decoded(shot, working_px)
    except MemoryError:
        if not patience.wait(MEMORY_WAIT_S):
            raise
        return _decoded(shot, working_px)


def _unchanged(shot: Shot, patience: Patience) -> Shot:
    """Return the shot if its file is the one of the header pass, or one with the same tags."""
    if shot.stamp is None or stamp_of(shot.path) == shot.stamp:
        return shot
    stamp = settled(shot.path, patience)
    options = IntakeOptions(min_side_px=16, focal_35mm=None)
    again = read_shot(shot.path, shot.name, options)
    same = (again.width_px, again.height_px, again.orientation, again.time_s, again.gps) == (
        shot.width_px,
        shot.height_px,
        shot.orientation,
        shot.time_s,
        again.gps if shot.positions_from_file else shot.gps,
    )
    if not same:
        raise PhotographError(shot.name, "the file was replaced by another photograph during the run; run again")
    return replace(shot, stamp=stamp)


def _decoded(shot: Shot, working_px: int) -> WorkingImage:
    with quiet(), opened(shot.path, shot.name, pixels=True) as image:
        try:
            reduced = _reduce(image, shot, working_px)
        except (MemoryError, PhotographError):
            raise
        except Exception as error:  # decoders fail in many ways on damaged data
            raise PhotographError(shot.name, f"pixels cannot be decoded ({str(error)[:200]})") from error
    if shot.orientation in _UPRIGHT:
        reduced = _turned(reduced, shot.orientation)
    rgb = np.array(reduced, dtype=np.uint8)
    height, width = rgb.shape[:2]
    return WorkingImage(shot, rgb, PixelMap(width / shot.width_px, height / shot.height_px))


def _reduce(image: Image | RawImage, shot: Shot, working_px: int) -> Image:
    from PIL.Image import Resampling

    full_width, full_height = image.size
    factor = min(1.0, working_px / max(full_width, full_height))
    size = max(1, round(full_width * factor)), max(1, round(full_height * factor))
    box: tuple[float, float, float, float] | None = (0, 0, full_width, full_height)
    if image.format == "DNG":
        rgb, box = image.developed(max(size)), None  # type: ignore[union-attr]
    elif shot.deep:
        require_memory(image, shot.name)  # type: ignore[arg-type]
        rgb, box = _deep(image, shot), None  # type: ignore[arg-type]
    else:
        # JPEG's DCT scaling (1/2, 1/4, 1/8) decodes what is needed; its last row and column may be partly empty.
        drafted = image.draft("RGB", size)  # type: ignore[union-attr]
        if drafted:
            box = drafted[1]
        require_memory(image, shot.name)  # type: ignore[arg-type]
        rgb = _to_rgb(image)  # type: ignore[arg-type]
    if rgb.size == size and (box is None or size == (full_width, full_height)):
        return rgb
    if box in (None, (0, 0, *rgb.size)) and rgb.width >= size[0] and rgb.height >= size[1]:
        return _mean_over_areas(rgb, size)
    return rgb.resize(size, Resampling.LANCZOS, box=box)


def _mean_over_areas(rgb: Image, size: tuple[int, int]) -> Image:
    """Reduce a picture; each pixel becomes the mean of the area it covers, in half of the time of Pillow's filters."""
    import cv2
    from PIL.Image import fromarray

    return fromarray(cv2.resize(np.asarray(rgb), size, interpolation=cv2.INTER_AREA))


def _deep(image: Image, shot: Shot) -> Image:
    orientation = image.getexif().get(0x0112, 1)
    upright = image.size
    rgb = deep_to_rgb(image, shot.value_range)
    # Pillow turns TIFFs while it decodes them, OpenCV does not.
    turn = image.format == "TIFF" and not image.mode.startswith("I") and orientation in _UPRIGHT
    rgb = _turned(rgb, orientation) if turn else rgb
    if rgb.size != upright:
        raise ValueError("the picture has another size than its header says")
    return rgb


def _turned(image: Image, orientation: int) -> Image:
    from PIL.Image import Transpose

    return image.transpose(Transpose[_UPRIGHT[orientation]])


def _to_rgb(image: Image) -> Image:
    if image.mode in ("P", "PA"):
        image = image.convert("RGBA")
    return image.convert("RGB")
