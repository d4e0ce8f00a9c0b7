"""The header pass: one photograph's tags to a `Shot`, without decoding its pixels."""

from __future__ import annotations

import calendar
import re
from datetime import datetime
from pathlib import Path

from ..errors import PhotographError
from ..options import IntakeOptions
from ..records import Shot
from .attitude import read_above_takeoff_m, read_attitude
from .deep import is_deep
from .focal import LEAST_FOCAL_MM, MOST_FOCAL_MM, focal_prior
from .opening import opened, quiet, require_memory
from .position import read_fix
from .stamp import stamp_of
from .tags import Tags, read_tags

TRANSPOSED = (5, 6, 7, 8)  # EXIF orientations that swap width and height
TURNED_BY_READER = frozenset({"TIFF", "HEIF", "DNG"})  # these come upright
FIRST_YEAR, LAST_YEAR = 1970, 2100  # cameras without a clock start in 1970 or 1980, or say 0000 or 9999
_TIME = re.compile(r"(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d):(\d\d):(\d\d)(\.\d{1,12})?", re.ASCII)


def read_shot(path: Path, name: str, options: IntakeOptions) -> Shot:
    """Return the shot of one file; raises `PhotographError` when the file cannot be used at all.

    Shots share intrinsics (camera key) when maker, model, lens, focal length and upright size agree: portrait
    and landscape frames of one camera are thus calibrated apart, which costs little and never mixes axes.
    """
    stamp = stamp_of(path)
    with quiet(), opened(path, name) as image:
        tags = read_tags(image)
        width, height = image.size
        orientation = 1 if image.format in TURNED_BY_READER else _orientation(tags)
        deep = is_deep(image)
        copies = _further_pictures(image)
        if image.format != "JPEG":  # JPEG is decoded at a reduced size, which is looked at then
            require_memory(image, name)
    if orientation in TRANSPOSED:
        width, height = height, width
    if min(width, height) < options.min_side_px:
        raise PhotographError(name, f"{width} x {height} px: the shorter side is below {options.min_side_px} px")
    _refuse_panorama(tags, name)
    fix, fix_warnings = read_fix(tags)
    attitude, attitude_warnings = read_attitude(tags)
    focal = focal_prior(tags, width, height, options.focal_35mm)
    time_s, time_warnings = _capture_time_s(tags)
    warnings = [*tags.warnings, *fix_warnings, *attitude_warnings, *time_warnings]
    if focal.source == "guess":
        warnings.append("no focal length in the tags: guessed")
    if copies:
        warnings.append(f"the file holds {copies + 1} pictures of this size: only the first is used")
    return Shot(
        name=name,
        path=path,
        width_px=width,
        height_px=height,
        camera_key=_camera_key(tags, width, height),
        focal_ratio=focal.ratio,
        focal_ratio_sigma=focal.sigma,
        focal_source=focal.source,
        time_s=time_s,
        orientation=orientation,
        gps=fix,
        attitude=attitude,
        above_takeoff_m=read_above_takeoff_m(tags),
        deep=deep,
        stamp=stamp,
        warnings=tuple(warnings),
    )


def _refuse_panorama(tags: Tags, name: str) -> None:
    projection = tags.xmp_text("GPano:ProjectionType").lower()
    if projection not in ("", "perspective", "rectilinear"):
        raise PhotographError(
            name,
            f"this is a panorama ({projection[:40]} projection), stitched from photographs: use those single "
            "photographs instead",
        )


def _further_pictures(image: object) -> int:
    """Return how many further pictures of the same size an MPO file holds; previews are smaller and do not count."""
    if getattr(image, "format", "") != "MPO":
        return 0
    entries = (getattr(image, "mpinfo", None) or {}).get(0xB002, ())
    kinds = [entry.get("Attribute", {}).get("MPType", "") for entry in entries if isinstance(entry, dict)]
    return sum(kind.startswith("Multi-Frame") for kind in kinds[1:])


def _orientation(tags: Tags) -> int:
    value = tags.number("Orientation")
    return int(value) if value is not None and value in range(1, 9) else 1


def _camera_key(tags: Tags, width: int, height: int) -> str:
    focal_mm = tags.number("FocalLength", LEAST_FOCAL_MM, MOST_FOCAL_MM)
    parts = [tags.text("Make"), tags.text("Model"), tags.text("LensModel"), f"{focal_mm:g} mm" if focal_mm else ""]
    return " ".join(part for part in (*parts, f"{width}x{height}") if part)


def _capture_time_s(tags: Tags) -> tuple[float | None, tuple[str, ...]]:
    """Return seconds since 1970 in the camera's own clock, and what was odd about the tags."""
    odd: tuple[str, ...] = ()
    for name, fraction in (
        ("DateTimeOriginal", "SubsecTimeOriginal"),
        ("DateTimeDigitized", "SubsecTimeDigitized"),
        ("DateTime", "SubsecTime"),
    ):
        match = _TIME.match(tags.text(name))
        if match is None:
            continue
        year, month, day, hour, minute, second = (int(group) for group in match.groups()[:6])
        if year == 0:
            continue  # what cameras write whose clock was never set
        try:
            datetime(year, month, day, hour, minute, min(second, 59))
            possible = FIRST_YEAR <= year <= LAST_YEAR and second <= 60
        except ValueError:
            possible = False
        if not possible:
            odd = (f"a capture time of {match[0][:40]} is not possible: left out",)
            continue
        digits = match[7] or ""
        subseconds = tags.text(fraction)
        if not digits and subseconds.isascii() and subseconds.isdigit():
            digits = f".{subseconds[:12]}"
        return calendar.timegm((year, month, day, hour, minute, second)) + float(digits or 0.0), ()
    return None, odd
