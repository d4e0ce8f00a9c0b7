"""Photographs looked at before they are processed: positions, overlap, blur, exposure, tags, time and memory.

Nothing is reconstructed. Overlap follows from positions, angles and flying heights in the tags on level ground.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np

from ..earth.positions import Positions, usable_positions
from ..errors import Cancelled, PhotographError
from ..files.atomic import write_text
from ..files.owned import OwnedFolder
from ..geometry.arrays import Float
from ..geometry.camera import Camera
from ..geometry.frames import enu_from_cam_rotation
from ..geometry.geodesy import WorldFrame, utm_crs_for
from ..geometry.transforms import Rigid3
from ..intake.images import load_working_image
from ..intake.quality import Quality, measure_quality
from ..intake.reading import read_flight
from ..options import Options
from ..products.clip import in_ring
from ..products.footprints import Footprint, footprint, with_overlap
from ..protocol import Progress, ProgressCallback
from ..records import PlacedCamera, RefusedPhotograph, Shot
from .estimate import estimated_memory_mib, estimated_time_s
from .flying_height import measured_height_m

Verdict = Literal["good", "doubtful", "unusable"]

CHECK_FILES = ("check.json", "check.csv")
BLURRED_SHARE = 0.75  # of the flight's median sharpness: sharp flights stay above 0.85, a blur of 1 px is below 0.7
BLURRED = 0.5  # however blurred the rest of the flight is
LOST_SHARE = 0.25  # of the pixels black or white
LEAST_CONTRAST = 6.0
LEAST_OVERLAP = 0.5  # with the neighbour that shows most of the same ground
LEAST_COVERED = 0.6  # of the ground in three photographs: below it the map falls apart
SAMPLES = 12  # per side of a footprint


@dataclass(frozen=True)
class CheckedPhotograph:
    """One photograph and what is to be said about it; None where the tags do not tell."""

    image: str
    verdict: Verdict
    problems: tuple[str, ...]
    x: float | None = None  # in the check's CRS, m
    y: float | None = None
    height_m: float | None = None  # as tagged
    above_ground_m: float | None = None
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    gsd_m: float | None = None
    overlap: int | None = None  # photographs that cover the middle of its ground, itself included
    best_overlap: float | None = None  # share of its ground in the neighbour that shows most of it
    covered: float | None = None  # share of its ground in at least three photographs
    sharpness: float | None = None
    dark: float | None = None
    bright: float | None = None
    contrast: float | None = None
    width_px: int | None = None
    height_px: int | None = None
    camera: str = ""
    focal_source: str = ""
    time_s: float | None = None
    footprint: tuple[tuple[float, float], ...] = ()  # outline in the check's CRS, m


@dataclass(frozen=True)
class FlightCheck:
    """What the photographs of one folder allow."""

    photographs: tuple[CheckedPhotograph, ...]
    crs: str | None  # of x, y and the footprints; None without positions
    vertical: str
    warnings: tuple[str, ...]
    time_s: float | None  # estimate of a run with these options; None when it cannot be told
    memory_mib: float

    def summary(self) -> dict[str, Any]:
        """Return the figures of the whole flight as JSON values."""
        rows = self.photographs
        verdicts = [row.verdict for row in rows]
        return {
            "given": len(rows),
            **{name: verdicts.count(name) for name in ("good", "doubtful", "unusable")},
            "with_position": sum(row.x is not None for row in rows),
            "crs": self.crs,
            "vertical": self.vertical,
            "median_best_overlap": _median([row.best_overlap for row in rows]),
            "median_overlap": _median([row.overlap for row in rows]),
            "covered": _mean([row.covered for row in rows]),
            "gsd_m": _median([row.gsd_m for row in rows]),
            "above_ground_m": _median([row.above_ground_m for row in rows]),
            "estimated_time_s": self.time_s,
            "estimated_memory_mib": self.memory_mib,
            "warnings": list(self.warnings),
        }


def check_photographs(
    photos: Path,
    options: Options | None = None,
    above_ground_m: float | None = None,
    progress: ProgressCallback | None = None,
    cancel: Callable[[], bool] | None = None,
) -> FlightCheck:
    """Look at every photograph of a folder.

    Args:
        photos: the folder, as for a run.
        options: of the run that is planned; time, memory and sharpness are judged for them.
        above_ground_m: flying height; replaces what the drone states above its take-off. Where neither is known, it
            is measured between photographs.
        progress: told after every photograph.
        cancel: asked before every photograph; true raises `Cancelled`.

    Raises `InputError` when the folder or an option is wrong.
    """
    options = options or Options()
    flight = read_flight(Path(photos), options)
    shots, refused = flight.shots, flight.refused
    measured = _measure(shots, options, progress, cancel)
    positions = usable_positions(range(len(shots)), dict(enumerate(shots)), options.georeference)
    crs, world = _projected(positions, options)
    heights = {i: above_ground_m or shot.above_takeoff_m for i, shot in enumerate(shots)}
    measured_m = None
    if not any(heights.values()):
        measured_m = measured_height_m(shots, world)
        heights = dict.fromkeys(heights, measured_m)
    grounds = _footprints(shots, world, heights)
    rows = [_row(i, shot, measured[i], positions, world, heights, grounds) for i, shot in enumerate(shots)]
    rows = _judged(rows, shots)
    rows += [CheckedPhotograph(item.name, "unusable", (item.reason,)) for item in refused]
    usable = [shot for shot, row in zip(shots, rows, strict=False) if row.verdict != "unusable"]
    return FlightCheck(
        photographs=tuple(rows),
        crs=crs,
        vertical=positions.vertical,
        warnings=(
            *flight.warnings,
            *positions.warnings,
            *_flight_warnings(rows, shots, refused, positions, measured_m),
        ),
        time_s=estimated_time_s(usable, options),
        memory_mib=estimated_memory_mib(len(usable), options),
    )


def write_check(out: Path, checked: FlightCheck) -> Path:
    """Write check.json and, for spreadsheets, check.csv into `out`; return the first.

    Raises as `OwnedFolder.claim` does: files of these names that are not ours are left alone.
    """
    document = {"summary": checked.summary(), "photographs": [asdict(row) for row in checked.photographs]}
    table = io.StringIO()
    columns = [name for name in CheckedPhotograph.__dataclass_fields__ if name != "footprint"]
    writer = csv.DictWriter(table, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({**asdict(row), "problems": "; ".join(row.problems)} for row in checked.photographs)
    with OwnedFolder.claim(out, "check", names=CHECK_FILES, guest=True) as folder, folder.scratch() as made:
        write_text(made / CHECK_FILES[0], json.dumps(document, ensure_ascii=False, indent=1, allow_nan=False))
        write_text(made / CHECK_FILES[1], table.getvalue())
        folder.publish(made, "check")
    return out / CHECK_FILES[0]


# ---------------------------------------------------------------------- pixels


def _measure(
    shots: Sequence[Shot],
    options: Options,
    progress: ProgressCallback | None,
    cancel: Callable[[], bool] | None,
) -> list[Quality | PhotographError]:
    def measure(shot: Shot) -> Quality | PhotographError:
        if cancel is not None and cancel():
            return PhotographError(shot.name, "not looked at")
        try:
            return measure_quality(load_working_image(shot, options.backbone.working_px).rgb)
        except PhotographError as error:
            return error

    measured = []
    with ThreadPoolExecutor(options.backbone.threads or os.cpu_count() or 1) as pool:
        for done, quality in enumerate(pool.map(measure, shots), start=1):
            if cancel is not None and cancel():
                raise Cancelled("stopped on request; nothing was written")
            measured.append(quality)
            if progress is not None:
                progress(Progress("looking at photographs", done, len(shots)))
    return measured


# ---------------------------------------------------------------------- ground


def _projected(positions: Positions, options: Options) -> tuple[str | None, dict[int, Float]]:
    """Return the CRS and, by photograph, easting, northing and height."""
    if not positions.images:
        return None, {}
    crs = options.georeference.crs or utm_crs_for(positions.frame.lat_deg, positions.frame.lon_deg)
    world = WorldFrame(crs, positions.vertical, positions.frame).from_enu(positions.enu)
    return crs, dict(zip(positions.images, world, strict=True))


def _footprints(
    shots: Sequence[Shot], world: Mapping[int, Float], heights: Mapping[int, float | None]
) -> dict[int, Footprint]:
    """Return what photographs with a position and a flying height cover; without angles they look straight down."""
    found = {}
    for index, place in world.items():
        shot, height_m = shots[index], heights[index]
        if height_m is None or height_m <= 0.0:
            continue
        yaw, pitch, roll = _angles(shot) or (_heading_deg(index, world), -90.0, 0.0)
        focal_px = shot.focal_ratio * max(shot.width_px, shot.height_px)
        camera = Camera(shot.width_px, shot.height_px, focal_px, focal_px, shot.width_px / 2, shot.height_px / 2)
        pose = Rigid3(enu_from_cam_rotation(yaw, pitch, roll), place)
        seen = footprint(PlacedCamera(index, shot.name, camera, pose, 0), float(place[2]) - height_m)
        if seen is not None:
            found[index] = seen
    return dict(zip(found, with_overlap(list(found.values())), strict=True))


def _angles(shot: Shot) -> tuple[float, float, float] | None:
    attitude = shot.attitude
    return None if attitude is None else (attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg)


def _heading_deg(index: int, world: Mapping[int, Float]) -> float:
    """Return the direction of flight at a photograph, from north clockwise."""
    order = sorted(world)
    place = order.index(index)
    ahead, behind = world[order[min(place + 1, len(order) - 1)]], world[order[max(place - 1, 0)]]
    east, north = (ahead - behind)[:2]
    return float(np.degrees(np.arctan2(east, north)))


def _shared_ground(index: int, grounds: Mapping[int, Footprint]) -> tuple[float, float]:
    """Return which share of a footprint the best neighbour shows, and which share at least two others show."""
    corners = grounds[index].outline[[0, 2, 4, 6]]
    u, v = (values.ravel()[:, None] for values in np.meshgrid(*2 * [(np.arange(SAMPLES) + 0.5) / SAMPLES]))
    top, bottom = corners[0] + u * (corners[1] - corners[0]), corners[3] + u * (corners[2] - corners[3])
    points = top + v * (bottom - top)
    counts, best = np.zeros(len(points), int), 0.0
    low, high = points.min(axis=0), points.max(axis=0)
    for other, item in grounds.items():
        apart = (item.outline.max(axis=0) < low).any() or (item.outline.min(axis=0) > high).any()
        if other == index or apart:
            continue
        inside = in_ring(points, item.outline)
        counts += inside
        best = max(best, float(inside.mean()))
    return best, float(np.mean(counts >= 2))


# ---------------------------------------------------------------------- verdicts


def _row(
    index: int,
    shot: Shot,
    quality: Quality | PhotographError,
    positions: Positions,
    world: Mapping[int, Float],
    heights: Mapping[int, float | None],
    grounds: Mapping[int, Footprint],
) -> CheckedPhotograph:
    place, ground = world.get(index), grounds.get(index)
    yaw, pitch, roll = _angles(shot) or (None, None, None)
    best, covered = _shared_ground(index, grounds) if ground else (None, None)
    figures = asdict(quality) if isinstance(quality, Quality) else {}
    return CheckedPhotograph(
        image=shot.name,
        verdict="good" if figures else "unusable",
        problems=() if isinstance(quality, Quality) else (quality.reason,),
        x=None if place is None else float(place[0]),
        y=None if place is None else float(place[1]),
        height_m=shot.gps.height_m if shot.gps else None,
        above_ground_m=heights[index],
        yaw_deg=yaw,
        pitch_deg=pitch,
        roll_deg=roll,
        gsd_m=ground.gsd_m if ground else None,
        overlap=ground.overlap if ground else None,
        best_overlap=best,
        covered=covered,
        **figures,
        width_px=shot.width_px,
        height_px=shot.height_px,
        camera=shot.camera_key,
        focal_source=shot.focal_source,
        time_s=shot.time_s,
        footprint=tuple((float(x), float(y)) for x, y in ground.outline) if ground else (),
    )


def _judged(rows: Sequence[CheckedPhotograph], shots: Sequence[Shot]) -> list[CheckedPhotograph]:
    sharp = median([row.sharpness for row in rows if row.sharpness is not None] or [0.0])
    judged = []
    for row, shot in zip(rows, shots, strict=True):
        doubts = _doubts(row, sharp)
        notes = [text for text in shot.warnings if text not in doubts]
        verdict: Verdict = "doubtful" if doubts and row.verdict == "good" else row.verdict
        judged.append(replace(row, verdict=verdict, problems=(*row.problems, *doubts, *notes)))
    return judged


def _doubts(row: CheckedPhotograph, flight_sharpness: float) -> list[str]:
    doubts = []
    if row.x is None:
        doubts.append("no position in the tags")
    if row.sharpness is not None and row.sharpness < max(BLURRED, BLURRED_SHARE * flight_sharpness):
        doubts.append(f"blurred: sharpness {row.sharpness:.2f}, the flight's {flight_sharpness:.2f}")
    if row.dark is not None and row.dark > LOST_SHARE:
        doubts.append(f"too dark: {100 * row.dark:.0f} % black")
    if row.bright is not None and row.bright > LOST_SHARE:
        doubts.append(f"too bright: {100 * row.bright:.0f} % white")
    if row.contrast is not None and row.contrast < LEAST_CONTRAST:
        doubts.append("hardly any contrast: fog, water, or the lens cap")
    if row.best_overlap is not None and row.best_overlap < LEAST_OVERLAP:
        doubts.append(f"overlap of {100 * row.best_overlap:.0f} % with its best neighbour")
    if row.covered is not None and row.covered < LEAST_COVERED / 2:
        doubts.append(f"only {100 * row.covered:.0f} % of its ground is in three photographs")
    return doubts


def _flight_warnings(
    rows: Sequence[CheckedPhotograph],
    shots: Sequence[Shot],
    refused: Sequence[RefusedPhotograph],
    positions: Positions,
    measured_m: float | None,
) -> list[str]:
    warnings = []
    without = sum(shot.gps is None for shot in shots)
    if without:
        warnings.append(f"{without} of {len(shots)} photographs have no position")
    if positions.distinct < 3:
        warnings.append("fewer than three different positions: the result cannot be georeferenced")
    if measured_m is not None:
        warnings.append(f"no flying height in the tags: about {measured_m:.0f} m, measured between photographs")
    elif shots and not any(row.footprint for row in rows):
        warnings.append("no flying height in the tags: overlap cannot be told; name the height above ground")
    covered = _mean([row.covered for row in rows])
    if covered is not None and covered < LEAST_COVERED:
        warnings.append(
            f"only {100 * covered:.0f} % of the ground is in three photographs: "
            "expect gaps; fly with 70 % overlap along and 60 % across the lines"
        )
    guessed = sum(shot.focal_source == "guess" for shot in shots)
    if guessed:
        warnings.append(f"{guessed} photographs do not tell their focal length: it is guessed, which costs accuracy")
    cameras = {shot.camera_key for shot in shots}
    if len(cameras) > 1:
        warnings.append(f"{len(cameras)} cameras or image sizes: each is calibrated apart")
    if refused:
        warnings.append(f"files that cannot be used: {len(refused)}")
    return warnings


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(median(known)) if known else None


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
