"""The CRS of a position file, taken whole: datum, units and the vertical part, to WGS 84 positions and heights in m.

No ballpark transformations, and no height that PROJ would pass on unchanged because a grid is missing: a vertical
reference without a grid at hand keeps its own numbers (in metres) and is called unknown.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import ReferenceFormatError
from ..records import VerticalReference

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

MAX_CRS_CHARACTERS = 8192
ACCURATE_M = 1.0  # transformations that are stated to be worse are told
VERTICAL_DATUMS: dict[int, VerticalReference] = {5773: "egm96", 3855: "egm2008"}
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)

Position = tuple[float, float, float | None]


@dataclass(frozen=True)
class SourceCrs:
    """How the numbers of a file become longitude, latitude (deg) and height (m)."""

    convert: Callable[[float, float, float | None], Position]
    vertical: VerticalReference
    warnings: tuple[str, ...]


def source_crs(text: str, where: str, sample: tuple[float, float]) -> SourceCrs:
    """Return the conversion of a file whose first line is `text`.

    Args:
        text: a code such as EPSG:4326 or EPSG:26849+6360, a PROJ string, WKT, or "WGS84 UTM 33N".
        where: the file, for messages.
        sample: x and y of a position, which says where on Earth the transformation must hold.

    Raises `ReferenceFormatError` when the CRS is unknown or cannot be tied to WGS 84.
    """
    crs = _crs(text, where)
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    vertical = crs.sub_crs_list[1] if crs.is_compound and len(crs.sub_crs_list) > 1 else None
    if crs.is_geocentric or (vertical is None and len(crs.axis_info) == 3):
        transformer, told = _transformer(crs, "EPSG:4979", where, sample)
        needs_z = bool(crs.is_geocentric)
        return SourceCrs(lambda x, y, z: _three(transformer, x, y, z, needs_z), "ellipsoidal", tuple(told))
    transformer, told = _transformer(horizontal, "EPSG:4326", where, sample)
    factor, reference = _height(crs, horizontal, vertical, where, told)
    return SourceCrs(
        lambda x, y, z: (*_two(transformer, x, y), None if z is None else z * factor), reference, tuple(told)
    )


def _height(
    crs: CRS, horizontal: CRS, vertical: CRS | None, where: str, told: list[str]
) -> tuple[float, VerticalReference]:
    """Return metres per unit of the heights and what they count from."""
    if vertical is None:
        axes = horizontal.axis_info
        factor = float(axes[0].unit_conversion_factor) if horizontal.is_projected and axes else 1.0
        if abs(factor - 1.0) > 1e-9:
            told.append(
                f"{where}: its CRS names no height, so heights were taken in its unit, the {axes[0].unit_name}; name a "
                "vertical part too (as in EPSG:26849+6360) if they are in another unit"
            )
        return factor, "unknown"
    axis = crs.axis_info[-1]
    factor = float(axis.unit_conversion_factor) * (-1.0 if axis.direction.lower() == "down" else 1.0)
    code = vertical.to_epsg()
    known = VERTICAL_DATUMS.get(code) if code else None
    if known is None:
        lowered = vertical.name.lower()
        known = next((ref for word, ref in (("egm96", "egm96"), ("egm2008", "egm2008")) if word in lowered), None)  # type: ignore[misc]
        if known is None and "ellips" in lowered:
            known = "ellipsoidal"
    if known is None:
        told.append(
            f"{where}: its heights count from {vertical.name}, for which no geoid grid is at hand: they stay as they "
            "are, in metres, and their reference is called unknown"
        )
    return factor, known or "unknown"


def _two(transformer: Transformer, x: float, y: float) -> tuple[float, float]:
    lon, lat = transformer.transform(x, y)
    return float(lon), float(lat)


def _three(transformer: Transformer, x: float, y: float, z: float | None, needs_z: bool) -> Position:
    if z is None and needs_z:
        return math.inf, math.inf, None  # no place
    lon, lat, height = transformer.transform(x, y, 0.0 if z is None else z)
    return float(lon), float(lat), None if z is None else float(height)


def _crs(text: str, where: str) -> CRS:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    utm = _UTM.fullmatch(text)
    if utm:
        text = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    elif re.fullmatch(r"WGS\s*84", text, re.IGNORECASE):
        text = "EPSG:4326"
    try:
        if len(text) > MAX_CRS_CHARACTERS or not text.isprintable():
            raise CRSError("no CRS")
        return CRS.from_user_input(text)
    except (CRSError, RecursionError, ValueError) as error:
        raise ReferenceFormatError(
            f"{where}: the first line must be a CRS such as EPSG:4326, EPSG:32633 or 'WGS84 UTM 33N', not {text[:80]!r}"
        ) from error


def _transformer(crs: CRS, target: str, where: str, sample: tuple[float, float]) -> tuple[Transformer, list[str]]:
    """Return the best transformation at hand at the place of the sample, and what is to be told about it."""
    from pyproj import Transformer
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "best transformation is not available": told below
        try:
            rough = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*sample)
            group = TransformerGroup(
                crs, target, always_xy=True, allow_ballpark=False, area_of_interest=_around(rough[0], rough[1])
            )
            found = list(group.transformers)
        except ProjError as error:
            found, group = [], error  # type: ignore[assignment]
    if not found:
        raise ReferenceFormatError(
            f"{where}: PROJ knows no transformation from {crs.name} to WGS 84 but a ballpark one, which may be off by "
            "hundreds of metres; name a CRS with a datum, such as EPSG:32633"
        )
    told = []
    accuracy = float(found[0].accuracy)
    if not 0.0 <= accuracy <= ACCURATE_M:
        stated = "unknown" if accuracy < 0.0 else f"{accuracy:g} m"
        told.append(f"{where}: accuracy of the datum shift from {crs.name} to WGS 84: {stated} (PROJ)")
    missing = _missing_grids(group) if not getattr(group, "best_available", True) else ""
    if missing and told:
        told[-1] += f"; a better one needs the grid {missing}"
    return found[0], told


def _around(lon: float, lat: float) -> Any:
    from pyproj.aoi import AreaOfInterest

    if not (math.isfinite(lon) and math.isfinite(lat) and abs(lon) <= 180.0 and abs(lat) <= 90.0):
        return None
    return AreaOfInterest(lon, lat, lon, lat)


def _missing_grids(group: Any) -> str:
    for operation in group.unavailable_operations:
        for grid in operation.grids:
            if not grid.available:
                return str(grid.short_name)
    return ""
