"""Reference candidates of new images: retrieval, and GPS positions as a second voice that proposes, never decides."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

import numpy as np

from ..geometry.arrays import Float
from ..records import GpsFix, Neighbour, Shot
from .index import RetrievalIndex

METRES_PER_DEGREE = 111_320.0
BEFORE_AND_AFTER = 2  # photographs of the map, each way in capture order


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


def add_capture_neighbours(
    proposed: dict[int, list[Neighbour]],
    queries: Sequence[int],
    shots: Mapping[int, Shot],
    placed: Container[int],
    index: RetrievalIndex,
) -> None:
    """Add to the proposals of some queries the placed images that were taken just before and after each.

    For images whose neighbours by looks and by position did not do: what was taken in a row overlaps, however it looks.
    """
    order = sorted(shots, key=lambda i: shots[i].capture_order)
    place = {shot: k for k, shot in enumerate(order)}
    for query in queries:
        k = place[query]
        found = []
        for side in (order[k + 1 :], order[:k][::-1]):
            near = [i for i in side[: 10 * BEFORE_AND_AFTER] if i in placed and i in index]
            found += near[:BEFORE_AND_AFTER]
        known = {n.index for n in proposed[query]}
        new = [i for i in found if i not in known]
        similarity = index.similarities([query], new)[0] if new else ()
        proposed[query] += [Neighbour(i, float(s)) for i, s in zip(new, similarity, strict=True)]
