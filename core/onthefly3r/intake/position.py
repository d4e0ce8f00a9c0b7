"""Position and its stated accuracy of one photograph from its tags: EXIF and XMP, checked against each other."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from ..records import GpsFix
from .heights import read_height
from .tags import Tags, finite, within

METRES_PER_DEGREE = 111_320.0
# Positions written in steps below this are equally fine: of those, EXIF counts, which correction programs rewrite.
FINE_M = 0.1
DIFFERENT_M = 5.0  # EXIF and XMP that lie further apart are told
LEAST_SIGMA_M, MOST_SIGMA_M = 0.001, 1_000.0
_DECIMAL = (
    ("drone-dji:GpsLatitude", ("drone-dji:GpsLongitude", "drone-dji:GpsLongtitude")),  # DJI's own spelling once
    ("drone:GpsLatitude", ("drone:GpsLongitude", "drone:GpsLongtitude")),
    ("drone-skydio:Latitude", ("drone-skydio:Longitude",)),
    ("exif:GPSLatitude", ("exif:GPSLongitude",)),
)
_SEXAGESIMAL = re.compile(r"(\d{1,3}),(\d{1,2})(?:,(\d{1,2})|(\.\d{1,20})?)([NSEW])")


@dataclass(frozen=True)
class _Place:
    """A latitude and longitude as written: how fine, and whether its hemispheres were stated."""

    lat_deg: float
    lon_deg: float
    step_m: float
    missing: tuple[str, ...] = ()  # names of the reference tags that are not there


def read_fix(tags: Tags) -> tuple[GpsFix | None, tuple[str, ...]]:
    """Return the position and what was assumed; None when the tags hold no fix.

    Where EXIF and XMP hold different positions, the one that is written finer counts, with its signs.
    """
    warnings: list[str] = []
    place = _chosen(_exif_place(tags, warnings), _xmp_place(tags), warnings)
    if place is None:
        return None, (*warnings, "no position in the tags") if not warnings else tuple(warnings)
    height, vertical, said = read_height(tags)
    warnings += said
    if height is None:
        warnings.append("position without a height")
    rtk = tags.xmp_number("drone-dji:RtkFlag", "drone:RtkFlag", low=0.0, high=255.0)
    sigma_h, sigma_v = _sigmas(tags, warnings)
    fix = GpsFix(place.lat_deg, place.lon_deg, height, vertical, sigma_h, sigma_v, None if rtk is None else round(rtk))
    return fix, tuple(warnings)


def _chosen(exif: _Place | None, xmp: _Place | None, warnings: list[str]) -> _Place | None:
    if exif is None or xmp is None:
        place = exif or xmp
        if place is not None:
            _say_missing(place, warnings)
        return place
    lat = math.copysign(exif.lat_deg, xmp.lat_deg) if "GPSLatitudeRef" in exif.missing else exif.lat_deg
    lon = math.copysign(exif.lon_deg, xmp.lon_deg) if "GPSLongitudeRef" in exif.missing else exif.lon_deg
    if exif.missing:
        warnings.append(f"{' and '.join(exif.missing)} missing: the signs of the XMP position were taken")
    signed = _Place(lat, lon, exif.step_m)
    finer = xmp if exif.step_m > FINE_M and xmp.step_m < exif.step_m else signed
    apart = distance_m(signed.lat_deg, signed.lon_deg, xmp.lat_deg, xmp.lon_deg)
    if apart > DIFFERENT_M:
        warnings.append(
            "the positions in EXIF and XMP differ by more than 5 m: "
            + ("XMP's was taken, which is written finer" if finer is xmp else "EXIF's was taken")
        )
    return finer


def _say_missing(place: _Place, warnings: list[str]) -> None:
    for name in place.missing:
        warnings.append(f"{name} is missing: {'north' if 'Lat' in name else 'east'} assumed")


def distance_m(lat: float, lon: float, other_lat: float, other_lon: float) -> float:
    """Return the distance of two places on the sphere, m."""
    a, b, half = math.radians(lat), math.radians(other_lat), math.radians(other_lon - lon) / 2.0
    chord = math.sin((b - a) / 2.0) ** 2 + math.cos(a) * math.cos(b) * math.sin(half) ** 2
    return 2.0 * math.degrees(math.asin(min(1.0, math.sqrt(chord)))) * METRES_PER_DEGREE


def _exif_place(tags: Tags, warnings: list[str]) -> _Place | None:
    latitude, longitude = (_degrees(tags.gps.get(f"GPS{axis}")) for axis in ("Latitude", "Longitude"))
    if latitude is None or longitude is None:
        return None
    (lat, step), (lon, other_step) = latitude, longitude
    missing = []
    for axis, negative in (("Latitude", "S"), ("Longitude", "W")):
        letter = _letter(tags.gps.get(f"GPS{axis}Ref"))
        if letter not in ("NS" if axis == "Latitude" else "EW") or not letter:
            missing.append(f"GPS{axis}Ref")
        elif axis == "Latitude":
            lat = -abs(lat) if letter == negative else lat
        else:
            lon = -abs(lon) if letter == negative else lon
    return _on_earth(_Place(lat, lon, max(step, other_step) * METRES_PER_DEGREE, tuple(missing)), warnings)


def _xmp_place(tags: Tags) -> _Place | None:
    for lat_name, lon_names in _DECIMAL:
        lat = _written(tags.xmp.get(lat_name, ""))
        lon = next((v for name in lon_names if (v := _written(tags.xmp.get(name, ""))) is not None), None)
        if lat is not None and lon is not None:
            place = _on_earth(_Place(lat[0], lon[0], max(lat[1], lon[1]) * METRES_PER_DEGREE), [])
            if place is not None:
                return place
    return None


def _on_earth(place: _Place, warnings: list[str]) -> _Place | None:
    if abs(place.lat_deg) > 90.0 or abs(place.lon_deg) > 180.0:
        warnings.append(f"position {place.lat_deg:.6g}, {place.lon_deg:.6g} is not on the Earth")
        return None
    if place.lat_deg == 0.0 and place.lon_deg == 0.0:
        warnings.append("position 0, 0 means no fix")
        return None
    return place


def _written(text: str) -> tuple[float, float] | None:
    """Return degrees and the step they are written in of decimal degrees or of XMP's "48,21.1367N"."""
    text = text.strip()
    match = _SEXAGESIMAL.fullmatch(text)
    if match:
        degrees, minutes, seconds, decimals, letter = match.groups()
        value = int(degrees) + (float(minutes + (decimals or "")) + int(seconds or 0) / 60.0) / 60.0
        step = 1.0 / 3600.0 if seconds else 10.0 ** -len((decimals or ".")[1:]) / 60.0
        return (-value if letter in "SW" else value), step
    number = within(text, -360.0, 360.0)
    if number is None:
        return None
    decimals = re.fullmatch(r"[+-]?\d*\.?(\d*)", text)
    return number, 10.0 ** -len(decimals[1]) if decimals else 1e-9


def _degrees(value: Any) -> tuple[float, float] | None:
    """Return degrees, and the finest step they are written in, of an EXIF (degrees, minutes, seconds) triple.

    A part that is 0/0 voids the fix.
    """
    parts = list(value[:3]) if isinstance(value, tuple | list) else [value]
    numbers = [within(part, -1e6, 1e6) for part in parts]
    known = [number for number in numbers if number is not None]
    if not known or len(known) < len(numbers):
        return None
    step = min(_step(part) / 60.0**power for power, part in enumerate(parts))
    return sum(number / 60.0**power for power, number in enumerate(known)), step


def _step(part: Any) -> float:
    denominator = finite(getattr(part, "denominator", None))
    if denominator is not None and denominator >= 1.0 and not isinstance(part, int):
        return 1.0 / denominator
    number = finite(part) or 0.0
    return next((10.0**-k for k in range(10) if abs(number - round(number, k)) < 1e-10), 1e-10)


def _letter(value: Any) -> str:
    if isinstance(value, bytes):
        value = value[:8].decode("ascii", "replace")
    return value.strip("\0 ").upper()[:1] if isinstance(value, str) else ""


def _sigmas(tags: Tags, warnings: list[str]) -> tuple[float | None, float | None]:
    """Return the stated standard deviations of the position, None where there are none that are possible.

    DJI's RtkStd* (m); `Camera:GPSXYAccuracy` and `GPSZAccuracy`, which Parrot writes as fractions of one sigma; EXIF's
    GPSHPositioningError.
    """
    lon, lat = (tags.xmp_number(f"drone-dji:RtkStd{axis}", f"drone:RtkStd{axis}") for axis in ("Lon", "Lat"))
    horizontal = max(lon, lat) if lon and lat else None
    if horizontal is None:
        horizontal = tags.xmp_number("Camera:GPSXYAccuracy")
    if horizontal is None:
        horizontal = finite(tags.gps.get("GPSHPositioningError"))
    vertical = tags.xmp_number("drone-dji:RtkStdHgt", "drone:RtkStdHgt") or tags.xmp_number("Camera:GPSZAccuracy")
    return possible_sigma(horizontal, warnings), possible_sigma(vertical, warnings)


def possible_sigma(value: float | None, warnings: list[str]) -> float | None:
    """Return a standard deviation in m unless it is impossible; 0 and negative ones mean unknown in many exports."""
    if value is None or value <= 0.0:
        return None
    if not LEAST_SIGMA_M <= value <= MOST_SIGMA_M:
        warnings.append(f"a position accuracy of {value:.3g} m is not possible: left out")
        return None
    return value
