"""Positions of photographs from a file (`geo.txt` of OpenDroneMap), in place of those in their tags."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from statistics import median

from ..errors import ReferenceFormatError
from ..geometry.geodesy import undulation_m
from ..records import Attitude, GpsFix, Shot
from .attitude import MAX_ANGLE_DEG, gimbal_of_body
from .heights import HIGHEST_HEIGHT_M, LOWEST_HEIGHT_M
from .position import distance_m, possible_sigma
from .positions_crs import SourceCrs, source_crs
from .positions_table import Row, read_table

# Positions of a file that lie this far from those in the tags, in the median, are told: corrections are smaller.
FAR_H_M, FAR_V_M = 20.0, 60.0
LOOKS_BACK_DEG = -60.0  # pitches below this, in a file in which 0 looks down, are a gimbal's


@dataclass(frozen=True)
class FilePosition:
    """One line of the file, its position in WGS 84."""

    name: str
    gps: GpsFix
    attitude: Attitude | None


@dataclass(frozen=True)
class PositionsFile:
    """What a position file says, and what is to be told about it."""

    positions: tuple[FilePosition, ...]
    warnings: tuple[str, ...] = ()


def read_positions(path: Path) -> PositionsFile:
    """Read a `geo.txt`: first line a CRS, then `name x y [z] [yaw pitch roll] [sigma_h sigma_v]`, `#` for comments.

    Angles need seven columns, accuracies nine; nan and, for accuracies, 0 and below stand for unknown. Angles are
    degrees as OpenDroneMap and Pix4D read them: pitch is 0 for a camera that looks down and 90 for one that looks to
    the horizon. The CRS counts whole: datum, units and vertical part (`positions_crs.py`).
    Raises `ReferenceFormatError` with the line.
    """
    crs, rows = read_table(path)
    source = source_crs(crs, path.name, (rows[0].numbers[0], rows[0].numbers[1]) if rows else (0.0, 0.0))
    twice = [name for name, count in Counter(row.name for row in rows).items() if count > 1]
    if twice:
        raise ReferenceFormatError(f"{path}: {twice[0]} is listed more than once")
    warnings = list(source.warnings)
    use_angles = _angles_are_usable(rows, path.name, warnings)
    flat = all(len(row.numbers) > 2 and row.numbers[2] == 0.0 for row in rows)
    if flat:
        warnings.append(f"{path.name}: all heights are 0, which counts as none")
    positions = tuple(_position(row, source, use_angles, flat, warnings) for row in rows)
    return PositionsFile(positions, tuple(dict.fromkeys(warnings)))


def with_positions(shots: Iterable[Shot], file: PositionsFile) -> tuple[list[Shot], list[str]]:
    """Return the shots with the positions of a file, and how file, photographs and tags agree.

    Shots that the file does not name have no position. A name is a path within the folder of photographs, or a file
    name where that is unique; case does not matter.
    Raises `ReferenceFormatError` when the file names none of the photographs.
    """
    shots = list(shots)
    by_path = {_key(p.name): p for p in file.positions}
    names = Counter(_key(PurePosixPath(shot.name).name) for shot in shots)
    found, used = [], set()
    for shot in shots:
        short = _key(PurePosixPath(shot.name).name)
        key = _key(shot.name) if _key(shot.name) in by_path else short if names[short] == 1 else ""
        position = by_path.get(key)
        used.add(key)
        found.append(
            replace(
                shot,
                gps=position.gps if position else None,
                attitude=(position.attitude if position else None) or shot.attitude,
                positions_from_file=True,
            )
        )
    if not any(shot.gps for shot in found):
        example = shots[0].name if shots else "-"
        raise ReferenceFormatError(f"the position file names none of the photographs; they are called like {example}")
    warnings = [*file.warnings, *_coverage(shots, found, names, by_path, used), *_compared(shots, found)]
    return found, warnings


def _coverage(
    shots: Sequence[Shot],
    found: Sequence[Shot],
    names: Counter[str],
    by_path: dict[str, FilePosition],
    used: set[str],
) -> list[str]:
    """Say which photographs the file does not list, and which of its lines name no photograph."""
    told = []
    unlisted = [shot.name for shot in found if shot.gps is None]
    if unlisted:
        told.append(
            f"{len(unlisted)} of {len(shots)} photographs are not in the position file, such as {unlisted[0]}: they "
            "have no position"
        )
    double = [name for name in unlisted if names[_key(PurePosixPath(name).name)] > 1]
    if double:
        told.append(
            f"{len(double)} of these share their file name with a photograph of another folder, such as {double[0]}: "
            "write the path within the folder of photographs into the position file"
        )
    unknown = [position.name for key, position in by_path.items() if key not in used]
    if unknown:
        told.append(f"{len(unknown)} lines of the position file name no photograph, such as {unknown[0]}")
    return told


def _compared(shots: Sequence[Shot], found: Sequence[Shot]) -> list[str]:
    """Say how far the file's positions are from those in the tags, where that is more than a correction."""
    pairs = [(a.gps, b.gps) for a, b in zip(shots, found, strict=True) if a.gps and b.gps]
    if not pairs:
        return []
    told = []
    apart = median(distance_m(tag.lat_deg, tag.lon_deg, new.lat_deg, new.lon_deg) for tag, new in pairs)
    if apart > FAR_H_M:
        swapped = median(distance_m(tag.lat_deg, tag.lon_deg, new.lon_deg, new.lat_deg) for tag, new in pairs)
        hint = "; latitude and longitude seem to be exchanged in the file" if swapped < apart / 10.0 else ""
        told.append(
            f"the position file's positions are {_distance(apart)} from those in the tags (median of "
            f"{len(pairs)}){hint}"
        )
    both = [(_ellipsoidal(tag), _ellipsoidal(new)) for tag, new in pairs]
    heights = [(tag, new) for tag, new in both if tag is not None and new is not None]
    if heights and abs(median(new - tag for tag, new in heights)) > FAR_V_M:
        ratios = [new / tag for tag, new in heights if tag]
        hint = "; are they in feet?" if ratios and abs(median(ratios) / 3.2808 - 1.0) < 0.1 else ""
        higher = median(new - tag for tag, new in heights)
        told.append(
            f"the position file's heights are {higher:+.0f} m from those in the tags (median of {len(heights)}){hint}"
        )
    return told


def _ellipsoidal(fix: GpsFix) -> float | None:
    if fix.height_m is None:
        return None
    import numpy as np

    return fix.height_m + float(undulation_m(fix.vertical, np.array(fix.lat_deg), np.array(fix.lon_deg)))


def _distance(metres: float) -> str:
    return f"{metres / 1000.0:.0f} km" if metres >= 10_000.0 else f"{metres:.0f} m"


def _key(name: str) -> str:
    return name.replace("\\", "/").casefold()


def _angles_are_usable(rows: Sequence[Row], where: str, warnings: list[str]) -> bool:
    pitches = [row.numbers[4] for row in rows if len(row.numbers) >= 6 and not math.isnan(row.numbers[4])]
    if pitches and median(pitches) < LOOKS_BACK_DEG:
        warnings.append(
            f"{where}: a pitch of {median(pitches):.0f} degrees would look backwards, since 0 looks down in a position "
            "file; these seem to be a gimbal's angles (-90 looks down): the file's angles are left out, add 90 to them"
        )
        return False
    angles = [row.numbers[3:6] for row in rows if len(row.numbers) >= 6]
    if angles and all(triple == (0.0, 0.0, 0.0) for triple in angles):
        warnings.append(f"{where}: all angles are 0, which counts as unknown")
        return False
    return True


def _position(row: Row, source: SourceCrs, use_angles: bool, flat: bool, warnings: list[str]) -> FilePosition:
    numbers = row.numbers
    given = numbers[2] if len(numbers) > 2 and not math.isnan(numbers[2]) and not flat else None
    lon, lat, height = source.convert(numbers[0], numbers[1], given)
    if not (abs(lon) <= 180.0 and abs(lat) <= 90.0):
        raise ReferenceFormatError(f"{row.where}: {numbers[0]}, {numbers[1]} is no place in the CRS of the first line")
    if height is not None and not LOWEST_HEIGHT_M <= height <= HIGHEST_HEIGHT_M:
        raise ReferenceFormatError(f"{row.where}: a height of {height:.6g} m is not possible")
    sigma_h, sigma_v = (possible_sigma(s, warnings) for s in (numbers[6:8] if len(numbers) == 8 else (None, None)))
    attitude = None
    if len(numbers) >= 6 and use_angles and not any(map(math.isnan, numbers[3:6])):
        if max(map(abs, numbers[3:6])) > MAX_ANGLE_DEG:
            raise ReferenceFormatError(f"{row.where}: angles must be degrees from -360 to 360")
        attitude = gimbal_of_body(*numbers[3:6])
    return FilePosition(row.name, GpsFix(lat, lon, height, source.vertical, sigma_h, sigma_v), attitude)
