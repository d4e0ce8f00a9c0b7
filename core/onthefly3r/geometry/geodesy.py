"""Local east-north-up, geographic and projected coordinates, and coordinate system texts.

All of it in float64. Horizontal datum of positions is WGS 84 (EPSG:4979). Heights are tied to the ellipsoid
inside; the bundled EGM96 grid converts heights above the geoid.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from ..errors import OptionError
from .arrays import Float
from .geoid import egm96_undulation_m
from .transforms import nearest_rotation

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

GEOCENTRIC, GEOGRAPHIC = "EPSG:4978", "EPSG:4979"
UPS_NORTH, UPS_SOUTH = "EPSG:5041", "EPSG:5042"  # axes east, north
VERTICAL_NAMES = {
    "ellipsoidal": "height above the WGS 84 ellipsoid",
    "egm96": "height above the EGM96 geoid (EPSG:5773)",
    "egm2008": "height above the EGM2008 geoid (EPSG:3855)",
    "relative": "height above the take-off point",
    "unknown": "unknown (as in the photographs' tags)",
}


def enu_rotation(lat_deg: float, lon_deg: float) -> Float:
    """Return the (3, 3) rotation ENU <- geocentric at a point of the ellipsoid."""
    sin_lat, cos_lat = np.sin(np.radians(lat_deg)), np.cos(np.radians(lat_deg))
    sin_lon, cos_lon = np.sin(np.radians(lon_deg)), np.cos(np.radians(lon_deg))
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def undulation_m(vertical: str, lat_deg: Float, lon_deg: Float) -> Float:
    """Return what to add to heights in `vertical` to get heights above the ellipsoid.

    EGM2008 heights use the EGM96 surface too: they leave as they came, and over a survey the two surfaces
    differ by millimetres. Relative and unknown heights are taken as they are.
    """
    if vertical in ("egm96", "egm2008"):
        return egm96_undulation_m(lat_deg, lon_deg)
    return np.zeros(np.shape(lat_deg))


@dataclass(frozen=True)
class EnuFrame:
    """A local east-north-up frame (m) tangent to WGS 84 at an origin of ellipsoidal height."""

    lat_deg: float
    lon_deg: float
    height_m: float

    def from_geographic(self, geographic: Float) -> Float:
        """Map (..., 3) latitude, longitude (deg) and ellipsoidal height (m) to ENU (..., 3)."""
        lat, lon, height = np.moveaxis(np.asarray(geographic, float), -1, 0)
        x, y, z = _geocentric_from_geographic().transform(lat, lon, height)
        return np.asarray((np.stack([x, y, z], axis=-1) - self._origin()) @ self._rotation().T)

    def to_geographic(self, enu: Float) -> Float:
        """Map ENU (..., 3) to latitude, longitude (deg) and ellipsoidal height (m)."""
        geocentric = np.asarray(enu, float) @ self._rotation() + self._origin()
        x, y, z = np.moveaxis(geocentric, -1, 0)
        lat, lon, height = _geocentric_from_geographic().transform(x, y, z, direction="INVERSE")
        return np.stack([lat, lon, height], axis=-1)

    def _rotation(self) -> Float:
        return enu_rotation(self.lat_deg, self.lon_deg)

    def _origin(self) -> Float:
        return np.array(_geocentric_from_geographic().transform(self.lat_deg, self.lon_deg, self.height_m))


@dataclass(frozen=True)
class WorldFrame:
    """The frame of the export: a projected CRS with heights in a vertical reference, tied to an ENU origin."""

    crs: str  # projected, metres, e.g. EPSG:32633
    vertical: str  # VerticalReference
    enu: EnuFrame

    def from_enu(self, points: Float) -> Float:
        """Map ENU points (N, 3) to easting, northing (m) and height in `vertical` (m), float64."""
        return self._from_enu(points, geoid=True)

    def to_enu(self, points: Float) -> Float:
        """Map easting, northing and height (N, 3) back to ENU."""
        east, north, height = np.moveaxis(np.asarray(points, float), -1, 0)
        lon, lat = projected_from_geographic(self.crs).transform(east, north, direction="INVERSE", errcheck=True)
        height = height + undulation_m(self.vertical, lat, lon)
        return self.enu.from_geographic(np.stack([lat, lon, height], axis=-1))

    def rotation_world_from_enu(self, at_enu: Float | None = None) -> Float:
        """Return the (3, 3) rotation of attitudes at an ENU point (default: the origin), world <- ENU.

        The rotation part of `from_enu`'s Jacobian: meridian convergence and the local vertical, no geoid slope.
        """
        centre = np.zeros(3) if at_enu is None else np.asarray(at_enu, float)
        steps = 10.0 * np.eye(3)
        ahead = self._from_enu(centre + steps, geoid=False)
        behind = self._from_enu(centre - steps, geoid=False)
        return nearest_rotation((ahead - behind).T / 20.0)

    def _from_enu(self, points: Float, geoid: bool) -> Float:
        lat, lon, height = np.moveaxis(self.enu.to_geographic(points), -1, 0)
        east, north = projected_from_geographic(self.crs).transform(lon, lat, errcheck=True)
        if geoid:
            height = height - undulation_m(self.vertical, lat, lon)
        return np.stack([east, north, height], axis=-1)


def utm_crs_for(lat_deg: float, lon_deg: float) -> str:
    """Return the EPSG code of the WGS 84 UTM zone of a point, UPS beyond 84 N and 80 S.

    A zone owns its western edge, the equator is northern, 180 E is zone 1; south-west Norway (32V) and
    Svalbard follow the UTM exceptions (NGA.SIG.0012).
    """
    if lat_deg > 84.0:
        return UPS_NORTH
    if lat_deg < -80.0:
        return UPS_SOUTH
    lon = (lon_deg + 180.0) % 360.0 - 180.0
    zone = int((lon + 180.0) // 6.0) + 1
    if 56.0 <= lat_deg < 64.0 and 3.0 <= lon < 12.0:
        zone = 32
    elif lat_deg >= 72.0 and 0.0 <= lon < 42.0:
        zone = next(z for z, edge in ((31, 9.0), (33, 21.0), (35, 33.0), (37, 42.0)) if lon < edge)
    return f"EPSG:{(32600 if lat_deg >= 0.0 else 32700) + zone}"


def projected_crs(text: str) -> CRS:
    """Return the horizontal CRS that a user named; raises `OptionError` unless it is projected and in metres."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_user_input(text)
    except CRSError:
        raise OptionError(f"crs: {text!r} is unknown to PROJ; give for example EPSG:32633") from None
    if crs.is_compound:
        raise OptionError(f"crs: {text} has a vertical part; give the horizontal CRS, heights follow 'vertical'")
    if not crs.is_projected:
        raise OptionError(f"crs: {text} ({crs.name}) is not projected; give for example the survey's UTM zone")
    if any(abs(axis.unit_conversion_factor - 1.0) > 1e-12 for axis in crs.axis_info[:2]):
        raise OptionError(f"crs: {text} ({crs.name}) is not in metres; choose a metric CRS such as the UTM zone")
    return crs.to_2d()


def scale_factor(crs: str, lat_deg: float, lon_deg: float) -> float:
    """Return the point scale of a projection at a place, the one of its two directions that is farther from 1.

    1.4 means that lengths in the CRS are 1.4 times those on the ellipsoid (PROJ's meridional and parallel scale).
    """
    from pyproj import Proj

    # PROJ takes the place on the CRS's own ellipsoid; the datum shift changes nothing of note.
    factors = Proj(projected_crs(crs)).get_factors(lon_deg, lat_deg)
    scales = (float(factors.meridional_scale), float(factors.parallel_scale))
    return max(scales, key=lambda scale: abs(scale - 1.0))


def transformation_accuracy_m(crs: str, lat_deg: float, lon_deg: float) -> float:
    """Return PROJ's stated accuracy of WGS 84 -> `crs` at a place with the grids at hand; NaN when it does not know.

    Raises `OptionError` when PROJ has no transformation but a ballpark one.
    """
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "best transformation is not available": the accuracy says it
        group = TransformerGroup(
            "EPSG:4326",
            projected_crs(crs),
            always_xy=True,
            area_of_interest=AreaOfInterest(lon_deg, lat_deg, lon_deg, lat_deg),
            allow_ballpark=False,
        )
    if not group.transformers:
        raise OptionError(
            f"crs: PROJ cannot transform WGS 84 to {crs} at {lat_deg:.4f}, {lon_deg:.4f}; use the UTM zone"
        )
    accuracy = float(group.transformers[0].accuracy)
    return accuracy if accuracy >= 0.0 else float("nan")


def wkt1(crs: str, vertical: str) -> str:
    """Return OGC WKT1 (GDAL dialect) of a projected CRS with a vertical reference, as LAS 1.4 wants it.

    A compound CRS for EGM96, EGM2008 and ellipsoidal heights (the last composed by hand: EPSG has no vertical
    CRS for it); for relative and unknown heights the projected CRS alone, since nothing truthful can be said.
    """
    from pyproj import CRS

    horizontal = projected_crs(crs)
    code = {"egm96": 5773, "egm2008": 3855}.get(vertical)
    projected = str(horizontal.to_wkt("WKT1_GDAL"))
    if code is not None:
        vertical_wkt = str(CRS.from_epsg(code).to_wkt("WKT1_GDAL"))
    elif vertical == "ellipsoidal":
        vertical_wkt = 'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1],AXIS["Up",UP]]'
    else:
        return projected
    return f'COMPD_CS["{horizontal.name} + {_short_name(vertical)}",{projected},{vertical_wkt}]'


def _short_name(vertical: str) -> str:
    return {"egm96": "EGM96 height", "egm2008": "EGM2008 height"}.get(vertical, "Ellipsoid (metre)")


@lru_cache(maxsize=1)
def _geocentric_from_geographic() -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs(GEOGRAPHIC, GEOCENTRIC)


@lru_cache(maxsize=8)
def projected_from_geographic(crs: str) -> Transformer:
    """Return the transformation from WGS 84 longitude, latitude to a projected CRS; raises `OptionError`."""
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    # No ballpark: it would shift the survey by up to hundreds of metres without a word.
    try:
        return Transformer.from_crs("EPSG:4326", projected_crs(crs), always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise OptionError(f"crs: PROJ cannot transform WGS 84 to {crs} ({error}); use the UTM zone") from None
