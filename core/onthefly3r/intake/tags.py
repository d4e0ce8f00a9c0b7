"""EXIF and XMP of one photograph as plain dictionaries; odd tags are left out, never fatal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from PIL.Image import Image

EXIF_IFD, GPS_IFD = 0x8769, 0x8825
MAX_XMP_BYTES = 1 << 20


@dataclass(frozen=True)
class Tags:
    """What the header says, by tag name; `xmp` is keyed by local name without namespace."""

    exif: Mapping[str, Any] = field(default_factory=dict)  # main and Exif IFD
    gps: Mapping[str, Any] = field(default_factory=dict)
    xmp: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def text(self, name: str) -> str:
        """Return an EXIF text without padding and control characters, "" when missing."""
        value = self.exif.get(name, "")
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        text = str(value).split("\0", 1)[0]
        return " ".join("".join(c for c in text if c.isprintable()).split())

    def number(self, name: str) -> float | None:
        """Return an EXIF number, None when missing, not finite or no number."""
        return finite(self.exif.get(name))

    def xmp_number(self, *names: str) -> float | None:
        """Return the first of these XMP numbers that is there and finite."""
        for name in names:
            value = finite(self.xmp.get(name))
            if value is not None:
                return value
        return None


def finite(value: Any) -> float | None:
    """Return a tag's value as a finite float; None for missing, 0/0, NaN and text."""
    if isinstance(value, tuple | list) and len(value) == 1:
        value = value[0]
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def read_tags(image: Image) -> Tags:
    """Return all tags of an opened image; unreadable blocks become warnings."""
    warnings: list[str] = []
    exif: dict[str, Any] = {}
    gps: dict[str, Any] = {}
    try:
        exif, gps = _read_exif(image)
    except Exception as error:  # Pillow's EXIF parser fails in many ways on damaged blocks
        warnings.append(f"EXIF cannot be read ({type(error).__name__})")
    packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    xmp: dict[str, str] = {}
    try:
        xmp = parse_xmp(packet.encode() if isinstance(packet, str) else bytes(packet))
    except ValueError as error:
        warnings.append(f"XMP left out: {error}")
    return Tags(exif, gps, xmp, tuple(warnings))


def parse_xmp(packet: bytes) -> dict[str, str]:
    """Return {local name: value} of an XMP packet's attributes and text elements; the first of a name counts.

    Raises `ValueError` when the packet is larger than 1 MiB, no XML, or uses entities or a DTD.
    """
    from defusedxml import ElementTree
    from defusedxml.common import DefusedXmlException

    if len(packet) > MAX_XMP_BYTES:
        raise ValueError(f"{len(packet)} bytes")
    packet = packet.strip(b"\0 \r\n\t")
    if not packet:
        return {}
    try:
        root = ElementTree.fromstring(packet, forbid_dtd=True)
    except (ElementTree.ParseError, DefusedXmlException, UnicodeError, LookupError) as error:
        raise ValueError(f"not well-formed ({type(error).__name__})") from error
    values: dict[str, str] = {}
    for element in root.iter():
        for key, value in element.attrib.items():
            values.setdefault(_local(key), value.strip())
        if len(element) == 0 and element.text and element.text.strip():
            values.setdefault(_local(element.tag), element.text.strip())
    return values


def _local(name: str) -> str:
    return name.rsplit("}", 1)[-1].rsplit(":", 1)[-1]


def _read_exif(image: Image) -> tuple[dict[str, Any], dict[str, Any]]:
    from PIL import ExifTags

    block = image.getexif()
    exif = {ExifTags.TAGS[tag]: value for tag, value in block.items() if tag in ExifTags.TAGS}
    details = block.get_ifd(EXIF_IFD)
    exif.update({ExifTags.TAGS[tag]: value for tag, value in details.items() if tag in ExifTags.TAGS})
    gps = {ExifTags.GPSTAGS[tag]: value for tag, value in block.get_ifd(GPS_IFD).items() if tag in ExifTags.GPSTAGS}
    return exif, gps
