"""Open a photograph: regular files only, header only, its memory reckoned before anything is decoded."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ..errors import PhotographError
from ..files.regular import BoundedReader, open_regular
from .recognise import HEAD_BYTES, can_read, kind_of, what_to_do

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = ("JPEG", "PNG", "TIFF")  # the JPEG reader also takes MPO, a JPEG with further pictures appended
MAX_PIXELS = 400_000_000
MAX_DECODED_BYTES = 768 << 20  # of one photograph while it is decoded
MAX_TAG_BYTES = 64 << 20  # read from a file before its pixels: a forged directory may point to gigabytes of holes
MAX_FILE_BYTES = 1 << 30  # read for its pixels
READABLE_MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "I;16", "I;16B", "I"})
_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}  # a pixel in Pillow's memory; all others take 4


@contextmanager
def opened(path: Path, name: str, pixels: bool = False) -> Iterator[Image]:
    """Yield the Pillow image of a file without decoding it; `pixels` lets it be decoded afterwards.

    Raises `PhotographError` for files that are empty, no photograph that can be read here (with what to do about it),
    larger than 400 Mpx or of a pixel type that is no photograph; `OSError` where the file cannot be opened.
    """
    with open_regular(path, MAX_TAG_BYTES) as stream:
        kind = _checked_kind(stream, name)
        if kind in ("heic", "dng"):  # their readers take the whole file
            stream.allow(MAX_FILE_BYTES)
        try:
            image = _open(stream, kind)
        except (MemoryError, PhotographError):
            raise
        except Exception as error:  # parsers of hostile headers fail in many ways; none may stop the run
            raise PhotographError(name, f"cannot be opened ({type(error).__name__}: {str(error)[:200]})") from error
        with image:
            width, height = image.size
            if width * height > MAX_PIXELS:
                raise PhotographError(name, f"{width} x {height} px is more than {MAX_PIXELS // 10**6} megapixels")
            if min(width, height) < 1:
                raise PhotographError(name, f"{width} x {height} px: there are no pixels")
            if image.mode not in READABLE_MODES:
                raise PhotographError(name, f"pixel type {image.mode} is not supported; convert it to 8-bit RGB")
            if pixels:
                stream.allow(min(MAX_FILE_BYTES, MAX_TAG_BYTES + 2 * decoded_bytes(image)))
            yield image


def decoded_bytes(image: Image) -> int:
    """Return the memory that decoding an opened image takes, at the size it is drafted to."""
    width, height = image.size
    pixels = width * height * _BYTES.get(image.mode, 4)
    if image.mode in ("P", "PA"):
        pixels += width * height * 8  # turned into RGBA, then RGB
    elif image.mode not in ("RGB", "L"):
        pixels *= 2
    if image.info.get("progressive"):
        # All coefficients of a progressive JPEG are kept, whatever size is asked for: 2 bytes, 3 full components.
        full = getattr(image, "_full_size", image.size)
        pixels += full[0] * full[1] * 6
    return int(pixels)


def require_memory(image: Image, name: str) -> None:
    """Raise `PhotographError` when an opened image takes more memory to decode than one photograph may."""
    needed = decoded_bytes(image)
    if needed > MAX_DECODED_BYTES:
        raise PhotographError(
            name,
            f"decoding its {image.size[0]} x {image.size[1]} px takes {needed >> 20} MiB, more than "
            f"{MAX_DECODED_BYTES >> 20} MiB; reduce it or save it as an ordinary JPEG",
        )


def _checked_kind(stream: BoundedReader, name: str) -> str:
    head = stream.read(HEAD_BYTES)
    stream.seek(0)
    if not head:
        raise PhotographError(name, "the file is empty")
    kind = kind_of(head)
    if kind in ("jpeg", "png", "tiff"):
        return kind
    if kind in ("heic", "dng"):
        if can_read(kind):
            return kind
        raise PhotographError(name, f"a {kind.upper()} file cannot be read here: {what_to_do(kind)}")
    if kind:
        raise PhotographError(name, f"this is {kind}: {what_to_do(kind)}")
    raise PhotographError(name, "no readable JPEG, PNG or TIFF image")


def _open(stream: BoundedReader, kind: str) -> Image:
    from PIL import Image, JpegImagePlugin, MpoImagePlugin, PngImagePlugin, TiffImagePlugin

    del JpegImagePlugin, MpoImagePlugin, PngImagePlugin, TiffImagePlugin  # importing a reader is what registers it
    # Pillow's own limit is a process-wide warning at 89 Mpx, below today's cameras; ours is checked after opening.
    Image.MAX_IMAGE_PIXELS = None
    source: Any = stream
    if kind == "heic":
        import pillow_heif

        pillow_heif.register_heif_opener()
        return Image.open(source, formats=("HEIF",))
    if kind == "dng":
        from .raw import RawImage

        return cast("Image.Image", RawImage(source))
    return Image.open(source, formats=FORMATS)


@contextmanager
def quiet() -> Iterator[None]:
    """Silence the parsers' complaints about odd tags; what matters becomes a warning of the shot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
