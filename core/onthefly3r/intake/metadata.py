"""The header pass: one photograph's tags to a `Shot`, without decoding its pixels."""

from __future__ import annotations

import calendar
import re
from pathlib import Path

from ..errors import PhotographError
from ..options import IntakeOptions
from ..records import Shot
from .focal import focal_prior
from .opening import opened, quiet
from .position import read_attitude, read_fix
from .tags import Tags, read_tags

TRANSPOSED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
_TIME = re.compile(r"(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d):(\d\d):(\d\d)(\.\d+)?")


def read_shot(path: Path, name: str, options: IntakeOptions) -> Shot:
    """Return the shot of one file; raises `PhotographError` when the file cannot be used at all.

    Shots share intrinsics (camera key) when maker, model, lens, focal length and upright size agree: portrait
    and landscape frames of one camera are thus calibrated apart, which costs little and never mixes axes.
    """
    with quiet(), opened(path, name) as image:
        tags = read_tags(image)
        width, height = image.size
        orientation = 1 if image.format == "TIFF" else _orientation(tags)  # Pillow turns TIFFs itself
    if orientation in TRANSPOSED:
        width, height = height, width
    if min(width, height) < options.min_side_px:
        raise PhotographError(name, f"{width} x {height} px: the shorter side is below {options.min_side_px} px")
    fix, fix_warnings = read_fix(tags)
    focal = focal_prior(tags, width, height, options.focal_35mm)
    warnings = [*tags.warnings, *fix_warnings]
    if focal.source == "guess":
        warnings.append("no focal length in the tags: guessed")
    return Shot(
        name=name,
        path=path,
        width_px=width,
        height_px=height,
        camera_key=_camera_key(tags, width, height),
        focal_ratio=focal.ratio,
        focal_ratio_sigma=focal.sigma,
        focal_source=focal.source,
        time_s=_capture_time_s(tags),
        orientation=orientation,
        gps=fix,
        attitude=read_attitude(tags),
        above_takeoff_m=tags.xmp_number("RelativeAltitude"),
        warnings=tuple(warnings),
    )


def _orientation(tags: Tags) -> int:
    value = tags.number("Orientation")
    return int(value) if value is not None and value in range(1, 9) else 1


def _camera_key(tags: Tags, width: int, height: int) -> str:
    focal_mm = tags.number("FocalLength")
    parts = [tags.text("Make"), tags.text("Model"), tags.text("LensModel"), f"{focal_mm:g} mm" if focal_mm else ""]
    return " ".join([*(part for part in parts if part), f"{width}x{height}"])


def _capture_time_s(tags: Tags) -> float | None:
    """Return seconds since 1970 of the camera's own clock, with sub-seconds; None when never set."""
    for name, fraction in (
        ("DateTimeOriginal", "SubsecTimeOriginal"),
        ("DateTimeDigitized", "SubsecTimeDigitized"),
        ("DateTime", "SubsecTime"),
    ):
        match = _TIME.match(tags.text(name))
        if match is None:
            continue
        year, month, day, hour, minute, second = (int(group) for group in match.groups()[:6])
        if not (year >= 1970 and 1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second < 62):
            continue
        digits = match.group(7) or ""
        subseconds = tags.text(fraction)
        if not digits and subseconds.isascii() and subseconds.isdigit():
            digits = f".{subseconds}"
        return calendar.timegm((year, month, day, hour, minute, second)) + float(digits or 0.0)
    return None
