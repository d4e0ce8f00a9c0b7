"""GPS fix and gimbal attitude of one photograph from its tags."""

from __future__ import annotations

from typing import Any

from ..records import Attitude, GpsFix, VerticalReference
from .tags import Tags, finite

RTK_FROM = 16  # DJI RtkFlag: 16 single, 32-49 float, 50 fixed; below there is no RTK solution


def read_fix(tags: Tags) -> tuple[GpsFix | None, tuple[str, ...]]:
    """Return the position and what was assumed; None when the tags hold no fix.

    The vertical reference follows DJI's RtkFlag and AltitudeType, senseFly's VerticCS and EXIF 3.0's
    GPSAltitudeRef; older EXIF says "sea level" but receivers write both, so it stays "unknown".
    """
    warnings: list[str] = []
    lat = _degrees(tags.gps.get("GPSLatitude"))
    lon = _degrees(tags.gps.get("GPSLongitude"))
    if lat is not None and lon is not None:
        lat, lon = _signed(tags, "Latitude", "S", lat, warnings), _signed(tags, "Longitude", "W", lon, warnings)
    else:
        lat = tags.xmp_number("GpsLatitude")
        lon = tags.xmp_number("GpsLongitude", "GpsLongtitude")  # DJI's own spelling in older firmware
    if lat is None or lon is None:
        return None, (*warnings, "no position in the tags")
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        return None, (*warnings, f"position {lat:.6f}, {lon:.6f} is not on the Earth")
    if lat == 0.0 and lon == 0.0:
        return None, (*warnings, "position 0, 0 means no fix")
    height, vertical = _height(tags)
    if height is None:
        warnings.append("position without a height")
    rtk = tags.xmp_number("RtkFlag")
    sigma_h, sigma_v = _sigmas(tags)
    fix = GpsFix(lat, lon, height, vertical, sigma_h, sigma_v, None if rtk is None else round(rtk))
    return fix, tuple(warnings)


def read_attitude(tags: Tags) -> Attitude | None:
    """Return DJI's gimbal angles; None unless all three are there."""
    yaw = tags.xmp_number("GimbalYawDegree")
    pitch = tags.xmp_number("GimbalPitchDegree")
    roll = tags.xmp_number("GimbalRollDegree")
    if yaw is None or pitch is None or roll is None or max(abs(yaw), abs(pitch), abs(roll)) > 360.0:
        return None
    return Attitude(yaw, pitch, roll)


def _height(tags: Tags) -> tuple[float | None, VerticalReference]:
    height = tags.xmp_number("AbsoluteAltitude")
    if height is not None:
        rtk = tags.xmp_number("RtkFlag")
        ellipsoidal = (rtk is not None and rtk >= RTK_FROM) or "rtk" in tags.xmp.get("AltitudeType", "").lower()
        return height, "ellipsoidal" if ellipsoidal else "egm96"
    height = finite(tags.gps.get("GPSAltitude"))
    if height is None:
        return None, "unknown"
    reference = _altitude_reference(tags.gps.get("GPSAltitudeRef"))
    height = -abs(height) if reference in (1, 3) else height
    surface = tags.xmp.get("VerticCS", "").lower()
    if "ellips" in surface:
        return height, "ellipsoidal"
    if "egm96" in surface or "egm 96" in surface:
        return height, "egm96"
    if reference in (2, 3):
        return height, "egm96"
    return height, "ellipsoidal" if _exif_version(tags) >= 300 else "unknown"


def _altitude_reference(value: Any) -> int:
    """EXIF 3.0: 0/1 above/below the ellipsoid, 2/3 above/below sea level; before: 0/1 about sea level."""
    if isinstance(value, bytes):
        return value[0] if value else 0
    number = finite(value)
    return 0 if number is None else int(number)


def _exif_version(tags: Tags) -> int:
    text = tags.text("ExifVersion")
    return int(text) if text.isascii() and text.isdigit() else 0


def _sigmas(tags: Tags) -> tuple[float | None, float | None]:
    lon, lat = tags.xmp_number("RtkStdLon"), tags.xmp_number("RtkStdLat")
    sigma_h = max(lon, lat) if lon is not None and lat is not None else None
    sigma_h = sigma_h or tags.xmp_number("GPSXYAccuracy") or finite(tags.gps.get("GPSHPositioningError"))
    sigma_v = tags.xmp_number("RtkStdHgt", "GPSZAccuracy")
    return _positive(sigma_h), _positive(sigma_v)


def _positive(value: float | None) -> float | None:
    return value if value is not None and value > 0.0 else None


def _degrees(value: Any) -> float | None:
    """Return degrees of an EXIF (degrees, minutes, seconds) triple; a part that is 0/0 voids the fix."""
    if isinstance(value, tuple | list):
        parts = [finite(part) for part in value[:3]]
        if not parts or any(part is None for part in parts):
            return None
        return sum(part / 60.0**power for power, part in enumerate(parts) if part is not None)
    return finite(value)


def _signed(tags: Tags, axis: str, negative: str, degrees: float, warnings: list[str]) -> float:
    reference = tags.gps.get(f"GPS{axis}Ref")
    if isinstance(reference, bytes):
        reference = reference.decode("ascii", "replace")
    letter = str(reference or "").strip("\0 ").upper()[:1]
    if letter not in ("N", "S", "E", "W"):
        warnings.append(f"GPS{axis}Ref is missing: {'north' if axis == 'Latitude' else 'east'} assumed")
    return -abs(degrees) if letter == negative else degrees
