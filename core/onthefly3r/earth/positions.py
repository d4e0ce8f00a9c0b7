"""The photographs' positions as arrays in a local frame, with one vertical reference and per-image sigmas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.geodesy import EnuFrame, undulation_m
from ..options import GeoreferenceOptions
from ..records import GpsFix, Shot, VerticalReference

FLIGHT_GAP_S = 180.0  # a longer pause between photographs is a landing: the height reference may start anew
FLIGHT_MIN_IMAGES = 5


@dataclass(frozen=True)
class Positions:
    """Positions of placed images, in the order of `images`."""

    images: tuple[int, ...]  # shot indices
    enu: Float  # (N, 3) m; up is 0 where the tags hold no height
    sigma_h_m: Float  # (N,) one standard deviation per horizontal axis
    sigma_v_m: Float  # (N,)
    has_height: Bool  # (N,)
    flight: Int  # (N,) flight number from 0
    order: Int  # (N,) positions in capture order
    distinct: int  # different positions
    frame: EnuFrame
    vertical: VerticalReference
    warnings: tuple[str, ...]


def usable_positions(images: Sequence[int], shots: Mapping[int, Shot], options: GeoreferenceOptions) -> Positions:
    """Return the positions of those images that have one; the origin is their median.

    Repeated positions (tags updated slower than photographs) share the weight of one.
    """
    images = tuple(i for i in images if shots[i].gps is not None)
    fixes = [fix for i in images if (fix := shots[i].gps) is not None]
    if not fixes:
        empty = np.zeros(0)
        frame = EnuFrame(0.0, 0.0, 0.0)
        return Positions(
            (), np.zeros((0, 3)), empty, empty, empty > 0, empty.astype(int), empty.astype(int), 0, frame, "unknown", ()
        )
    fixes, vertical, warnings = _one_vertical_reference(fixes, options)
    lat = np.array([fix.lat_deg for fix in fixes])
    lon = np.array([fix.lon_deg for fix in fixes])
    lon = lon[0] + (lon - lon[0] + 180.0) % 360.0 - 180.0  # no jump at the date line
    has_height = np.array([fix.height_m is not None for fix in fixes])
    tag_height = np.array([np.nan if fix.height_m is None else fix.height_m for fix in fixes])
    if not has_height.any():
        vertical = "unknown"
        warnings.append("no photograph states a height: the cameras' mean height is set to 0")
        tag_height = np.zeros(len(fixes))
    tag_height = np.where(np.isnan(tag_height), np.nanmedian(tag_height), tag_height)
    surface = [fix.vertical for fix in fixes] if vertical in ("egm96", "ellipsoidal") else [vertical] * len(fixes)
    height = tag_height + np.array([float(undulation_m(v, a, o)) for v, a, o in zip(surface, lat, lon, strict=True)])
    centre_lon = (float(np.median(lon)) + 180.0) % 360.0 - 180.0
    frame = EnuFrame(float(np.median(lat)), centre_lon, float(np.median(height)))
    times = [shots[i].time_s for i in images]
    key = [(round(fix.lat_deg, 9), round(fix.lon_deg, 9)) for fix in fixes]  # whatever the heights
    count = Counter(key)
    repeats = np.sqrt([count[k] for k in key])
    if len(count) < len(key):
        warnings.append(f"{len(key)} photographs share {len(count)} positions: repeated ones count once")
    noise_m = np.array([position_noise_m(fix, options) for fix in fixes])
    return Positions(
        images=images,
        enu=frame.from_geographic(np.stack([lat, lon, height], axis=-1)),
        sigma_h_m=repeats * noise_m[:, 0],
        sigma_v_m=repeats * noise_m[:, 1],
        has_height=has_height,
        flight=_flights(times),
        order=np.argsort([np.inf if t is None else t for t in times], kind="stable"),
        distinct=len(count),
        frame=frame,
        vertical=vertical,
        warnings=tuple(warnings),
    )


def position_noise_m(fix: GpsFix, options: GeoreferenceOptions) -> tuple[float, float]:
    """Return the standard deviations (m) of a position, horizontal per axis and vertical: stated, else the options'.

    The only noise model of positions: all stages that weigh them ask here.
    """
    return fix.sigma_h_m or options.gps_sigma_h_m, fix.sigma_v_m or options.gps_sigma_v_m


def _one_vertical_reference(
    fixes: list[GpsFix], options: GeoreferenceOptions
) -> tuple[list[GpsFix], VerticalReference, list[str]]:
    """Decide what the heights refer to: the option, else what most tags say; a minority does not decide for the rest.

    Where most tags agree, known references are converted to theirs and unknown ones taken for it.
    """
    if options.vertical != "auto":
        return [replace(fix, vertical=options.vertical) for fix in fixes], options.vertical, []
    said = Counter(fix.vertical for fix in fixes if fix.height_m is not None)
    if not said:
        return fixes, "unknown", []
    known = [v for v, _ in said.most_common() if v not in ("unknown", "relative")]
    sure = sum(said[v] for v in known) > 0.5 * said.total()
    vertical: VerticalReference = known[0] if known and sure else "unknown"
    warnings = []
    if len(said) > 1:
        text = ", ".join(f"{n} {v}" for v, n in said.most_common())
        warnings.append(
            f"the heights have different references ({text}) and are brought to {vertical}; check with --vertical"
            if sure
            else f"most heights do not say what they refer to ({text}): all are taken as they are, and the reference "
            "is called unknown; name it with --vertical"
        )
    if not sure:
        return [replace(fix, vertical="unknown") for fix in fixes], vertical, warnings
    return [f if f.vertical in known else replace(f, vertical=vertical) for f in fixes], vertical, warnings


def _flights(times_s: list[float | None]) -> Int:
    """Return flight numbers by pauses in capture time; pieces of fewer than five photographs join the one before."""
    flight = np.zeros(len(times_s), int)
    if any(time is None for time in times_s):
        return flight
    times = np.array(times_s, float)
    order = np.argsort(times, kind="stable")
    number, start = 0, 0
    for k in range(1, len(order)):
        rest = len(order) - k
        if times[order[k]] - times[order[k - 1]] > FLIGHT_GAP_S and min(k - start, rest) >= FLIGHT_MIN_IMAGES:
            number, start = number + 1, k
        flight[order[k]] = number
    return flight
