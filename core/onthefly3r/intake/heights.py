"""The height in a photograph's tags, and what surface it counts from: what the file states, else what is documented.

- `Camera:VertCS` (senseFly and others: `VerticCS`), `CRSInfo:VERTCRS`: the vertical reference of the EXIF altitude, a
  name or an EPSG code (Pix4D support, "Specifications of XMP Camera Tags").
- DJI: `AltitudeType` RtkAlt is a height above the ellipsoid, GpsFusionAlt one above sea level; without it, `RtkFlag`
  says whether there was an RTK solution (Zenmuse P1 user manual: 0 failed, 16 single, 32..49 float, 50 fixed).
  Sea level of the receivers is EGM96.
- EXIF 3.0 (CIPA DC-008-2023): GPSAltitudeRef 0 and 1 are above and below the ellipsoid, 2 and 3 sea level. Before,
  0 and 1 were called sea level, and receivers wrote either.
- Skydio: the EXIF altitude of RTK flights is above the ellipsoid, others are not documented. Autel and Parrot state no
  geoid. Their heights are unknown unless the file says otherwise.
"""

from __future__ import annotations

import re
from typing import Any

from ..records import VerticalReference
from .tags import Tags, finite

LOWEST_HEIGHT_M, HIGHEST_HEIGHT_M = -1_000.0, 50_000.0  # below the Dead Sea, above the balloons
RTK_FROM = 16  # RtkFlag below this has no RTK solution
SAME_M = 1.0
# Tags that hold a height of the photograph, apart from EXIF's.
_ALTITUDES = (
    "drone-dji:AbsoluteAltitude",
    "drone:AbsoluteAltitude",
    "drone-skydio:AbsoluteAltitude",
    "drone-yuneec:GPSAltitude",
    "exif:GPSAltitude",
)
_SURFACES = ("Camera:VertCS", "Camera:VerticCS", "CRSInfo:VERTCRS", "CRSInfo:VertCRS")
_KNOWN: dict[str, VerticalReference] = {
    "ellipsoidal": "ellipsoidal",
    "ellipsoid": "ellipsoidal",
    "wgs84": "ellipsoidal",
    "wgs84ellipsoid": "ellipsoidal",
    "epsg4979": "ellipsoidal",
    "egm96": "egm96",
    "egm1996": "egm96",
    "epsg5773": "egm96",
    "egm2008": "egm2008",
    "egm08": "egm2008",
    "epsg3855": "egm2008",
}


def read_height(tags: Tags) -> tuple[float | None, VerticalReference, tuple[str, ...]]:
    """Return the height (m), its reference and what is to be told; None where the tags hold no possible height."""
    warnings: list[str] = []
    exif = _possible(_exif_altitude(tags), warnings)
    name, other = next(((n, v) for n in _ALTITUDES if (v := finite(tags.xmp.get(n))) is not None), ("", None))
    other = _possible(other, warnings)
    surface = tags.xmp_text(*_SURFACES)
    if surface:
        stated = stated_surface(surface)
        if stated is None:
            warnings.append(f"heights refer to {surface[:40]!r}, which is not known here: their reference is unknown")
        height = exif if exif is not None else other
        return height, stated or "unknown" if height is not None else "unknown", tuple(warnings)
    if exif is not None and other is not None and abs(exif - other) > SAME_M:
        warnings.append(f"the heights in EXIF and XMP differ: {'XMP' if _is_dji(name) else 'EXIF'}'s is used")
    if other is not None and _is_dji(name):
        return other, _dji_reference(tags, warnings), tuple(warnings)
    if exif is None and other is None:
        return None, "unknown", tuple(warnings)
    version = _exif_version(tags)
    reference = _altitude_reference(tags.gps.get("GPSAltitudeRef"))
    if exif is not None and version >= 300:
        return exif, "egm96" if reference in (2, 3) else "ellipsoidal", tuple(warnings)
    if exif is not None and reference in (2, 3):
        return exif, "egm96", tuple(warnings)
    warnings.append("the tags do not say what the height refers to: name it with --vertical")
    return exif if exif is not None else other, "unknown", tuple(warnings)


def stated_surface(text: str) -> VerticalReference | None:
    """Return the vertical reference that a text names, None when it is none of ours."""
    word = re.sub(r"[^a-z0-9]", "", text.lower())
    if word in _KNOWN:
        return _KNOWN[word]
    if "ellips" in word:
        return "ellipsoidal"
    if "egm96" in word:
        return "egm96"
    return "egm2008" if "egm2008" in word else None


def _is_dji(name: str) -> bool:
    return name == "drone-dji:AbsoluteAltitude"


def _dji_reference(tags: Tags, warnings: list[str]) -> VerticalReference:
    kind = tags.xmp_text("drone-dji:AltitudeType").lower()
    flag = tags.xmp_number("drone-dji:RtkFlag", low=0.0, high=255.0)
    solved = flag is not None and flag >= RTK_FROM
    if "rtk" in kind:
        return "ellipsoidal"
    if kind and solved:
        warnings.append(
            f"AltitudeType {kind[:20]!r} and RtkFlag {flag:g} contradict each other: the height's reference is unknown"
        )
        return "unknown"
    return "ellipsoidal" if solved else "egm96"


def _exif_altitude(tags: Tags) -> float | None:
    height = finite(tags.gps.get("GPSAltitude"))
    below = _altitude_reference(tags.gps.get("GPSAltitudeRef")) in (1, 3)
    return -abs(height) if height is not None and below else height


def _possible(height: float | None, warnings: list[str]) -> float | None:
    """Return a height unless it is exactly 0 (nothing was measured) or nowhere on Earth."""
    if height is None:
        return None
    if height == 0.0:
        warnings.append("a height of exactly 0 counts as none")
        return None
    if not LOWEST_HEIGHT_M <= height <= HIGHEST_HEIGHT_M:
        warnings.append(f"a height of {height:.6g} m is not possible: left out")
        return None
    return height


def _altitude_reference(value: Any) -> int:
    if isinstance(value, bytes):
        return value[0] if value else 0
    number = finite(value)
    return int(number) if number is not None and 0.0 <= number <= 3.0 else 0


def _exif_version(tags: Tags) -> int:
    text = tags.text("ExifVersion")
    return int(text) if re.fullmatch(r"0[1-9]\d\d", text, re.ASCII) else 0
