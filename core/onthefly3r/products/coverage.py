"""What the photographs cover together, and the areas that too few of them show: where to fly again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.arrays import Float
from .footprints import Footprint

ENOUGH = 3  # photographs that show a point, for a height that is checked
GRID_CELLS = 1000  # along the longer side of the survey
LEAST_CELLS = 4  # smaller areas are the grid's, not the survey's


@dataclass(frozen=True)
class WeakArea:
    """An area that fewer than `ENOUGH` photographs show."""

    area: Any  # shapely Polygon, export frame
    photographs: int  # that show it
    reason: str


def covered(footprints: Sequence[Footprint]) -> Any:
    """Return the union of the footprints as a shapely MultiPolygon, empty without any."""
    import shapely

    union = shapely.union_all([shapely.make_valid(shapely.Polygon(item.outline)) for item in footprints])
    areas = [part for part in shapely.get_parts(union) if part.geom_type == "Polygon"]
    return shapely.MultiPolygon(areas)


def weak_areas(footprints: Sequence[Footprint]) -> list[WeakArea]:
    """Return the areas, the largest first, that too few photographs show, gaps that none shows included.

    They are found on a grid, so that time and memory are bounded for any number of photographs: outlines are exact to
    one cell, a thousandth of the survey's longer side.
    """
    import rasterio.features
    import shapely
    from rasterio.enums import MergeAlg
    from rasterio.transform import Affine

    if not footprints:
        return []
    union = covered(footprints)
    # Numbers of the grid stay small: projected coordinates would lose digits.
    origin = np.array(union.bounds[:2])
    extent = np.array(union.bounds[2:]) - origin
    cell = float(extent.max()) / GRID_CELLS
    width, height = (max(1, int(np.ceil(side / cell))) for side in extent)
    grid = {"out_shape": (height, width), "transform": Affine(cell, 0.0, 0.0, 0.0, cell, 0.0)}
    rings = [(shapely.Polygon(item.outline - origin), 1) for item in footprints]
    counts = rasterio.features.rasterize(rings, merge_alg=MergeAlg.add, dtype="int32", **grid)
    outer = [shapely.Polygon(np.asarray(part.exterior.coords) - origin) for part in union.geoms]
    inside = rasterio.features.rasterize(outer, dtype="uint8", **grid) > 0
    found = []
    shapes = rasterio.features.shapes(counts, mask=inside & (counts < ENOUGH), transform=grid["transform"])
    rim = shapely.MultiLineString([ring.exterior.coords for ring in outer])
    for shape, count in shapes:
        area = shapely.geometry.shape(shape)
        if area.area >= LEAST_CELLS * cell**2:
            is_rim = bool(area.distance(rim) <= cell)
            found.append(WeakArea(_moved(area, origin), int(count), _reason(int(count), is_rim)))
    return sorted(found, key=lambda weak: -weak.area.area)


def _moved(area: Any, origin: Float) -> Any:
    import shapely

    return shapely.transform(area, lambda points: points + origin)


def _reason(photographs: int, is_rim: bool) -> str:
    seen = ("no photograph shows it", "only 1 photograph shows it", "only 2 photographs show it")[photographs]
    where = "at the rim of the survey: fly one line further out" if is_rim else "inside the survey: fly here again"
    return f"{seen}, {where}"
