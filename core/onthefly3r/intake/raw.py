"""Digital negatives (DNG): tags by Pillow's EXIF reader, pixels developed by rawpy (extra `raw`)."""

from __future__ import annotations

import io
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from PIL.Image import Exif, Image

TURNED_SIDEWAYS = (5, 6)  # LibRaw's flip
XMP_TAG = 0x02BC


class RawImage:
    """What the header pass and the decoder want of an opened image, for a digital negative."""

    format = "DNG"
    mode = "RGB"

    def __init__(self, stream: IO[bytes]) -> None:
        import rawpy
        from PIL.Image import Exif

        data = stream.read()
        self._raw: Any = rawpy.imread(io.BytesIO(data))
        self._exif = Exif()
        self._exif.load_from_fp(io.BytesIO(data))
        packet = self._exif.get(XMP_TAG)
        self.info: dict[Any, Any] = {"xmp": bytes(packet)} if isinstance(packet, bytes | tuple) else {}
        sizes = self._raw.sizes
        upright = (sizes.height, sizes.width) if sizes.flip in TURNED_SIDEWAYS else (sizes.width, sizes.height)
        self.size: tuple[int, int] = upright

    def __enter__(self) -> RawImage:
        """Return the image itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Free the sensor data."""
        self._raw.close()

    def getexif(self) -> Exif:
        """Return the EXIF block."""
        return self._exif

    def developed(self, longest_px: int) -> Image:
        """Return the upright picture, at half size where that is enough; brightness alike in all photographs."""
        from PIL.Image import fromarray

        half = max(self.size) >= 2 * longest_px
        return fromarray(self._raw.postprocess(half_size=half, use_camera_wb=True, no_auto_bright=True))
