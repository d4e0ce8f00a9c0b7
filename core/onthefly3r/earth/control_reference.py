"""The georeference of an adjusted map: that of its ground control, or the similarity to positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..errors import GeoreferenceError, OptionError
from ..geometry.arrays import Float
from ..geometry.geodesy import VERTICAL_NAMES, EnuFrame, projected_crs
from ..geometry.transforms import Rigid3
from ..options import GeoreferenceOptions
from ..records import EarthTie, GeoReference, Shot
from .georef import georeference, target_crs
from .positions import usable_positions


def earth_reference(
    tie: EarthTie | None,
    map_from_cam: Mapping[int, Rigid3],
    shots: Mapping[int, Shot],
    options: GeoreferenceOptions,
    ground_normal: Float | None = None,
) -> GeoReference:
    """Return how a map lies on the Earth: as its control says, else by the robust similarity to positions.

    Raises what `georeference` raises.
    """
    if tie is None:
        try:
            return georeference(map_from_cam, shots, options, ground_normal)
        except GeoreferenceError as error:
            if options.control is None:
                raise
            raise GeoreferenceError(
                f"the ground control does not tie the map to the Earth (the report's warnings say why), and {error}"
            ) from error
    if not tie.by_control:
        fitted = georeference(map_from_cam, shots, options, ground_normal)
        return replace(fitted, deviations=tie.deviations, control=tie.control)
    frame = EnuFrame(tie.origin_lat_deg, tie.origin_lon_deg, tie.origin_height_m)
    positions = usable_positions(sorted(map_from_cam), shots, options)
    there = replace(positions, frame=frame, images=positions.images or (0,))
    crs = target_crs(options, there) if options.crs or not _usable(tie.crs) else str(tie.crs)
    enu = frame.from_geographic(positions.frame.to_geographic(positions.enu)) if positions.images else positions.enu
    residuals = {
        index: (float(e), float(n), float(u) if high else 0.0)
        for index, (e, n, u), high in zip(
            positions.images,
            enu
            - np.array([tie.enu_from_map.apply(map_from_cam[i].translation) for i in positions.images]).reshape(-1, 3),
            positions.has_height,
            strict=True,
        )
    }
    used = [point for point in tie.control if point.role == "control"]
    heights = [point.up_m for point in used if np.isfinite(point.up_m)]
    return GeoReference(
        enu_from_map=tie.enu_from_map,
        origin_lat_deg=frame.lat_deg,
        origin_lon_deg=frame.lon_deg,
        origin_height_m=frame.height_m,
        crs=crs,
        vertical=tie.vertical,
        method=(
            f"bundle adjustment with {len(used)} ground control points"
            + (f" and {len(positions.images)} camera positions" if positions.images else "")
            + f"; heights: {VERTICAL_NAMES[tie.vertical]}"
            + (", those of the control file" if tie.vertical == "unknown" else "")
        ),
        n_used=len(used),
        n_outliers=sum(point.role == "left out" for point in tie.control),
        rmse_h_m=float(np.sqrt(np.mean([p.east_m**2 + p.north_m**2 for p in used]))) if used else float("nan"),
        rmse_v_m=float(np.sqrt(np.mean(np.square(heights)))) if heights else float("nan"),
        residuals_m=residuals,
        warnings=positions.warnings,
        deviations=tie.deviations,
        control=tie.control,
    )


def _usable(crs: str | None) -> bool:
    """Return whether the control's CRS can be that of the result: projected and metric."""
    if crs is None:
        return False
    try:
        projected_crs(crs)
    except OptionError:
        return False
    return True
