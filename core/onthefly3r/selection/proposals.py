"""Reference candidates of new images: retrieval, and GPS positions as a second voice that proposes, never decides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.arrays import Float
from ..records import GpsFix, Neighbour
from .index import RetrievalIndex

METRES_PER_DEGREE = 111_320.0


def propose_references(
    queries: Sequence[int], index: RetrievalIndex, k: int, use_positions: bool
) -> dict[int, list[Neighbour]]:
    """Return N_k(q) (Eq. 5) of each query, to which its k nearest frames of the map by position may be added."""
    found = index.top(queries, k)
    if use_positions:
        for query in queries:
            known = {n.index for n in found[query]}
            found[query] += [n for n in index.nearest(query, k) if n.index not in known]
    return found


def plane_position(fix: GpsFix, origin: GpsFix) -> Float:
    """Return rough east and north (2,) in metres from an origin: good enough to tell who is near."""
    east_per_degree = METRES_PER_DEGREE * np.cos(np.radians(origin.lat_deg))
    east_deg = (fix.lon_deg - origin.lon_deg + 180.0) % 360.0 - 180.0
    return np.array([east_deg * east_per_degree, (fix.lat_deg - origin.lat_deg) * METRES_PER_DEGREE])
