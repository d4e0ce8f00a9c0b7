"""EXIF and XMP of one photograph as plain dictionaries; odd tags are left out, never fatal."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .xmp import parse_xmp

if TYPE_CHECKING:
    from PIL.Image import Image

EXIF_IFD, GPS_IFD = 0x8769, 0x8825
MAX_TEXT = 100  # characters of a name of maker, model or lens that are kept
XMP_SEGMENTS = (b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0")
_FRACTION = re.compile(r"([+-]?\d{1,20})/(\d{1,20})")


@dataclass(frozen=True)
class Tags:
    """What the header says, by tag name; `xmp` is keyed by `prefix:name` with the usual prefixes (`xmp.py`)."""

    exif: Mapping[str, Any] = field(default_factory=dict)  # main and Exif IFD
    gps: Mapping[str, Any] = field(default_factory=dict)
    xmp: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def text(self, name: str) -> str:
        """Return an EXIF text without padding and control characters, "" when missing."""
        value = self.exif.get(name, "")
        if isinstance(value, bytes):
            value = value[: 4 * MAX_TEXT].decode("utf-8", "replace")
        if not isinstance(value, str | int | float):
            return ""
        text = str(value)[: 4 * MAX_TEXT].split("\0", 1)[0]
        return " ".join("".join(c for c in text if c.isprintable()).split())[:MAX_TEXT]

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Return an EXIF number, None when missing, no finite number or outside `low`..`high`."""
        return within(self.exif.get(name), low, high)

    def xmp_number(self, *names: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Return the first of these XMP numbers that is there, finite and within bounds; fractions count."""
        for name in names:
            value = within(self.xmp.get(name), low, high)
            if value is not None:
                return value
        return None

    def xmp_text(self, *names: str) -> str:
        """Return the first of these XMP texts that is there, "" when none is."""
        return next((self.xmp[name] for name in names if self.xmp.get(name)), "")


def finite(value: Any) -> float | None:
    """Return a tag's value as a finite float; None for missing, 0/0, NaN and text. Texts may be fractions."""
    if isinstance(value, tuple | list) and len(value) == 1:
        value = value[0]
    if isinstance(value, bool | complex):
        return None
    if isinstance(value, str):
        fraction = _FRACTION.fullmatch(value.strip()) if "/" in value else None
        if fraction:
            above, below = int(fraction[1]), int(fraction[2])
            return above / below if below else None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def within(value: Any, low: float, high: float) -> float | None:
    """Return a tag's value as a float, None where it is none or outside `low`..`high`."""
    number = finite(value)
    return number if number is not None and low <= number <= high else None


def read_tags(image: Image) -> Tags:
    """Return all tags of an opened image; unreadable blocks become warnings."""
    warnings: list[str] = []
    exif: dict[str, Any] = {}
    gps: dict[str, Any] = {}
    try:
        exif, gps = _read_exif(image)
    except MemoryError:
        raise
    except Exception as error:  # Pillow's EXIF parser fails in many ways on damaged blocks
        warnings.append(f"EXIF cannot be read ({type(error).__name__})")
    return Tags(exif, gps, parse_xmp(_packets(image)), tuple(warnings))


def _packets(image: Image) -> list[bytes]:
    """Return all XMP packets of a file, in their order; a JPEG may hold several."""
    packets = [
        segment[len(mark) :]
        for name, segment in getattr(image, "applist", ())
        for mark in XMP_SEGMENTS
        if name == "APP1" and segment.startswith(mark)
    ]
    other = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    if isinstance(other, str):
        other = other.encode("utf-8", "replace")
    return packets or ([bytes(other)] if isinstance(other, bytes | bytearray) else [])


def _read_exif(image: Image) -> tuple[dict[str, Any], dict[str, Any]]:
    from PIL import ExifTags

    block = image.getexif()
    exif = {ExifTags.TAGS[tag]: value for tag, value in block.items() if tag in ExifTags.TAGS}
    details = block.get_ifd(EXIF_IFD)
    exif.update({ExifTags.TAGS[tag]: value for tag, value in details.items() if tag in ExifTags.TAGS})
    gps = {ExifTags.GPSTAGS[tag]: value for tag, value in block.get_ifd(GPS_IFD).items() if tag in ExifTags.GPSTAGS}
    return exif, gps
