"""Open a photograph with Pillow: header only, no pixels decoded, size checked before anything is allocated."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import PhotographError

if TYPE_CHECKING:
    from PIL.Image import Image

SUFFIXES = frozenset({".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff"})
FORMATS = ("JPEG", "PNG", "TIFF")  # the JPEG reader also takes MPO, a JPEG with a preview appended
MAX_PIXELS = 400_000_000
READABLE_MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "I;16", "I;16B", "I"})


@contextmanager
def opened(path: Path, name: str) -> Iterator[Image]:
    """Yield the Pillow image of a file without decoding it.

    Raises `PhotographError` for files that are empty, no JPEG/PNG/TIFF, larger than 400 Mpx or of a pixel
    type that is no photograph.
    """
    from PIL import Image, JpegImagePlugin, MpoImagePlugin, PngImagePlugin, TiffImagePlugin, UnidentifiedImageError

    del JpegImagePlugin, MpoImagePlugin, PngImagePlugin, TiffImagePlugin  # importing a reader is what registers it
    # Pillow's own limit is a process-wide warning at 89 Mpx, below today's cameras; ours is checked right below.
    Image.MAX_IMAGE_PIXELS = None
    try:
        image = Image.open(path, formats=FORMATS)
    except UnidentifiedImageError:
        reason = "the file is empty" if path.stat().st_size == 0 else "no readable JPEG, PNG or TIFF image"
        raise PhotographError(name, reason) from None
    except Exception as error:  # parsers of hostile headers fail in many ways; none may stop the run
        raise PhotographError(name, f"cannot be opened ({type(error).__name__}: {error})") from error
    with image:
        width, height = image.size
        if width * height > MAX_PIXELS:
            raise PhotographError(name, f"{width} x {height} px is more than {MAX_PIXELS // 10**6} megapixels")
        if image.mode not in READABLE_MODES:
            raise PhotographError(name, f"pixel type {image.mode} is not supported; convert it to 8-bit RGB")
        yield image


@contextmanager
def quiet() -> Iterator[None]:
    """Silence the parsers' complaints about odd tags; what matters becomes a warning of the shot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
