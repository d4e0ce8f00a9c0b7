"""EGM96 geoid undulation from the bundled 15-minute grid: height above ellipsoid = height above geoid + undulation.

PROJ without a geoid grid leaves heights as they are without a word, so the grid comes with the package
(origin, packing and accuracy: docs/adr/0003-geoid.md).
"""

from __future__ import annotations

import gzip
from functools import lru_cache
from importlib.resources import files

import numpy as np

from .arrays import Float

ROWS, COLUMNS, STEP_DEG = 721, 1440, 0.25  # from -90 to 90 and from -180 to 179.75


def egm96_undulation_m(lat_deg: Float | float, lon_deg: Float | float) -> Float:
    """Return the EGM96 geoid's height above the WGS 84 ellipsoid, bilinear between grid nodes, shape of the input.

    Accuracy: 0.5-1 m of the model itself; at NGA's test points the interpolation is within 6 cm.
    """
    lat, lon = np.broadcast_arrays(np.asarray(lat_deg, float), np.asarray(lon_deg, float))
    grid = _grid_m()
    row = np.clip((lat + 90.0) / STEP_DEG, 0.0, ROWS - 1.0)
    column = np.mod(lon + 180.0, 360.0) / STEP_DEG
    r0 = np.minimum(row.astype(int), ROWS - 2)
    c0 = column.astype(int) % COLUMNS
    c1 = (c0 + 1) % COLUMNS
    dr, dc = row - r0, column - np.floor(column)
    south = (1.0 - dc) * grid[r0, c0] + dc * grid[r0, c1]
    north = (1.0 - dc) * grid[r0 + 1, c0] + dc * grid[r0 + 1, c1]
    return np.asarray((1.0 - dr) * south + dr * north)


@lru_cache(maxsize=1)
def _grid_m() -> Float:
    """Return the grid (721, 1440) in metres; stored as differences of whole centimetres along both axes."""
    packed = gzip.decompress((files(__package__) / "egm96_15min.gz").read_bytes())
    difference = np.frombuffer(packed, "<i2").reshape(ROWS, COLUMNS).astype(np.int64)
    return np.asarray(np.cumsum(np.cumsum(difference, axis=0), axis=1) / 100.0)
