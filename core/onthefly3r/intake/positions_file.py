"""Positions of photographs from a file (`geo.txt` of OpenDroneMap), in place of those in their tags."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from ..errors import ReferenceFormatError
from ..records import Attitude, GpsFix, Shot

if TYPE_CHECKING:
    from pyproj import CRS

MAX_FILE_BYTES = 64 * 1024 * 1024
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


@dataclass(frozen=True)
class FilePosition:
    """One line of the file, its position in WGS 84."""

    name: str
    gps: GpsFix
    attitude: Attitude | None


def read_positions(path: Path) -> list[FilePosition]:
    """Read a `geo.txt`: first line a CRS, then `name x y [z] [yaw pitch roll] [sigma_h sigma_v]`, `#` for comments.

    Angles need seven columns, accuracies nine. Angles are degrees as OpenDroneMap reads them: pitch is 0 for a camera
    that looks down and 90 for one that looks to the horizon. Heights are taken for what the option `vertical` says.
    Raises `ReferenceFormatError` with the line.
    """
    from pyproj import Transformer

    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ReferenceFormatError(f"{path}: larger than {MAX_FILE_BYTES // 2**20} MiB")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ReferenceFormatError(f"{path} cannot be read ({error}); give a geo.txt in UTF-8") from error
    lines = [
        (number, line.split("#", 1)[0].strip())
        for number, line in enumerate(text.splitlines(), start=1)
        if line.split("#", 1)[0].strip()
    ]
    if len(lines) < 2:
        raise ReferenceFormatError(f"{path}: no positions; first a line with the CRS, then one line per photograph")
    to_geographic = Transformer.from_crs(_crs(lines[0][1], path), "EPSG:4326", always_xy=True)
    positions = [_position(line, f"{path}, line {number}", to_geographic.transform) for number, line in lines[1:]]
    twice = [name for name, count in Counter(p.name for p in positions).items() if count > 1]
    if twice:
        raise ReferenceFormatError(f"{path}: {twice[0]} is listed more than once")
    return positions


def with_positions(shots: Iterable[Shot], positions: Iterable[FilePosition]) -> list[Shot]:
    """Return the shots with the positions of a file; those that it does not name have none.

    A name is a path within the folder of photographs, or a file name where that is unique; case does not matter.
    Raises `ReferenceFormatError` when the file names none of the photographs.
    """
    shots = list(shots)
    by_path = {_key(p.name): p for p in positions}
    names = Counter(_key(PurePosixPath(shot.name).name) for shot in shots)
    found = []
    for shot in shots:
        short = _key(PurePosixPath(shot.name).name)
        position = by_path.get(_key(shot.name)) or (by_path.get(short) if names[short] == 1 else None)
        gps = position.gps if position else None
        attitude = (position.attitude if position else None) or shot.attitude
        found.append(replace(shot, gps=gps, attitude=attitude))
    if not any(shot.gps for shot in found):
        example = shots[0].name if shots else "-"
        raise ReferenceFormatError(f"the position file names none of the photographs; they are called like {example}")
    return found


def _key(name: str) -> str:
    return name.replace("\\", "/").casefold()


def _crs(text: str, path: Path) -> CRS:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    utm = _UTM.fullmatch(text)
    if utm:
        text = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise ReferenceFormatError(
            f"{path}: the first line must be a CRS such as EPSG:4326, EPSG:32633 or 'WGS84 UTM 33N', not {text!r}"
        ) from error


def _position(line: str, where: str, to_lon_lat: Callable[[float, float], tuple[float, float]]) -> FilePosition:
    name, *words = line.split("\t") if "\t" in line else line.split()
    try:
        numbers = [float(word) for word in words if word.strip()]
    except ValueError:
        raise ReferenceFormatError(
            f"{where}: expected name x y [z] [yaw pitch roll] [sigma_h sigma_v], found {line[:80]!r}"
        ) from None
    if len(numbers) not in (2, 3, 6, 8) or not all(map(math.isfinite, numbers)):
        raise ReferenceFormatError(f"{where}: {len(numbers)} numbers after the name; 2, 3, 6 or 8 are allowed")
    lon, lat = to_lon_lat(numbers[0], numbers[1])
    if not (abs(lon) <= 180.0 and abs(lat) <= 90.0):
        raise ReferenceFormatError(f"{where}: {numbers[0]}, {numbers[1]} is no place in the CRS of the first line")
    height = numbers[2] if len(numbers) > 2 else None
    sigma_h, sigma_v = (numbers[6], numbers[7]) if len(numbers) == 8 else (None, None)
    attitude = None
    if len(numbers) >= 6:
        yaw_deg, pitch_deg, roll_deg = numbers[3:6]
        attitude = Attitude(yaw_deg, pitch_deg - 90.0, roll_deg)  # here 0 looks down, in tags of gimbals -90 does
    return FilePosition(name.strip(), GpsFix(lat, lon, height, "unknown", sigma_h, sigma_v), attitude)
