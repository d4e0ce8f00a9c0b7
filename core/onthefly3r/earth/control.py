"""Ground control as records, and how lines of a file become them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import ReferenceFormatError

if TYPE_CHECKING:
    from pyproj import CRS

SIGMA_H_M, SIGMA_V_M = 0.02, 0.03  # of a point that states none: RTK and a steady pole
CHECKPOINT_PREFIX = "CHK-"
SAME_POINT_M = 0.001  # lines of one label whose coordinates differ by more contradict each other
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


@dataclass(frozen=True)
class ControlPoint:
    """A surveyed point; a checkpoint never takes part in the adjustment."""

    label: str
    lat_deg: float  # WGS 84
    lon_deg: float
    height_m: float | None  # in the vertical reference of the result
    sigma_h_m: float = SIGMA_H_M
    sigma_v_m: float = SIGMA_V_M
    checkpoint: bool = False
    given: tuple[float, float] = (0.0, 0.0)  # x and y as in the file


@dataclass(frozen=True)
class Mark:
    """Where a point was marked in a photograph, in pixels of the copy that was marked."""

    label: str
    image: str
    x_px: float
    y_px: float
    width_px: float | None = None  # of the copy, where the file tells
    where: str = ""  # file and line


@dataclass(frozen=True)
class Control:
    """Everything that a control file says."""

    points: Mapping[str, ControlPoint]
    marks: tuple[Mark, ...]
    crs: str
    path: Path
    warnings: tuple[str, ...] = ()

    def with_checkpoints(self, labels: str | None) -> Control:
        """Return the control with further checkpoints, labels separated by commas; raises for an unknown one."""
        points = dict(self.points)
        for label in (word.strip() for word in (labels or "").split(",") if word.strip()):
            if label not in points:
                known = ", ".join(sorted(points)[:20])
                raise ReferenceFormatError(f"checkpoints: {self.path} has no point {label!r}; it has {known}")
            points[label] = replace(points[label], checkpoint=True)
        return replace(self, points=points)


@dataclass
class Collected:
    """Points and marks while lines are read."""

    crs: Any
    path: Path
    to_lon_lat: Any = None
    points: dict[str, ControlPoint] = field(default_factory=dict)
    marks: list[Mark] = field(default_factory=list)

    def add_point(self, label: str, x: float, y: float, z: float | None, where: str, **more: Any) -> None:
        """Take one point; what `more` holds replaces the defaults. Raises for a contradiction."""
        if self.to_lon_lat is None:
            from pyproj import Transformer

            self.to_lon_lat = Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True).transform
        lon, lat = self.to_lon_lat(x, y)
        if not (math.isfinite(lon) and math.isfinite(lat) and abs(lat) <= 90.0):
            raise ReferenceFormatError(
                f"{where}: {x:.10g}, {y:.10g} is no place in {crs_name(self.crs)}; are the axes exchanged, or is it "
                "another CRS?"
            )
        new = ControlPoint(label, lat, lon, z, given=(x, y), checkpoint=label.upper().startswith(CHECKPOINT_PREFIX))
        new = replace(new, **{name: value for name, value in more.items() if value is not None})
        old = self.points.get(label)
        if old is not None:
            off = [abs(a - b) for a, b in zip(old.given, new.given, strict=True)]
            same = max(off) <= (1e-8 if self.crs.is_geographic else SAME_POINT_M) and old.height_m == new.height_m
            if not same:
                raise ReferenceFormatError(f"{where}: point {label} has other coordinates than in a line before")
            return
        self.points[label] = new

    def done(self) -> Control:
        """Return what was read; raises where nothing was, or marks have no point."""
        if not self.points:
            raise ReferenceFormatError(f"{self.path}: holds no control point")
        strays = sorted({mark.label for mark in self.marks} - set(self.points))
        if strays:
            raise ReferenceFormatError(f"{self.path}: {strays[0]} is marked in photographs but has no coordinates")
        return Control(self.points, tuple(self.marks), crs_name(self.crs), self.path)


def crs_of(text: str, where: str) -> CRS:
    """Return the CRS that a text names; raises `ReferenceFormatError`."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    utm = _UTM.fullmatch(text.strip())
    if utm:
        text = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    try:
        return CRS.from_user_input(text.strip())
    except CRSError as error:
        raise ReferenceFormatError(
            f"{where}: expected a CRS such as EPSG:32633 or 'WGS84 UTM 33N', not {text.strip()[:80]!r}"
        ) from error


def crs_name(crs: CRS) -> str:
    """Return its EPSG code where it has one."""
    epsg = crs.to_epsg()
    return f"EPSG:{epsg}" if epsg else str(crs.name if crs.name != "unknown" else crs.to_proj4())


def number_of(word: str, where: str, what: str) -> float:
    """Return a finite number, with a decimal point or comma; raises `ReferenceFormatError`."""
    try:
        value = float(word.replace(",", ".") if word.count(",") == 1 and "." not in word else word)
    except ValueError:
        raise ReferenceFormatError(f"{where}: {what} must be a number, not {word[:40]!r}") from None
    if not math.isfinite(value):
        raise ReferenceFormatError(f"{where}: {what} is not finite")
    return value
