"""Reference candidates of new images: retrieval, and GPS positions as a second voice that proposes, never decides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..geometry.arrays import Float
from ..records import Neighbour, Shot
from .index import RetrievalIndex

METRES_PER_DEGREE = 111_320.0


def propose_references(
    queries: Sequence[int],
    accepted: Sequence[int],
    index: RetrievalIndex,
    positions: Mapping[int, Float],
    k: int,
    use_positions: bool,
) -> dict[int, list[Neighbour]]:
    """Return N_k(q) (Eq. 5) of each query, to which its k nearest accepted frames by position may be added."""
    found = index.top(queries, accepted, k)
    if not use_positions:
        return found
    located = [i for i in accepted if i in positions]
    if len(located) == 0:
        return found
    table = np.array([positions[i] for i in located])
    for query in queries:
        if query not in positions:
            continue
        distance = np.linalg.norm(table - positions[query], axis=1)
        nearest = [located[i] for i in np.argsort(distance, kind="stable")[:k]]
        known = {n.index for n in found[query]}
        extra = [i for i in nearest if i not in known and i != query]
        if extra:
            similarity = index.similarities([query], extra)[0]
            found[query] += [Neighbour(i, float(s)) for i, s in zip(extra, similarity, strict=True)]
    return found


def plane_positions(shots: Mapping[int, Shot]) -> dict[int, Float]:
    """Return rough east and north in metres of the shots that have a position: good enough to tell who is near."""
    fixes = {i: shot.gps for i, shot in shots.items() if shot.gps is not None}
    if not fixes:
        return {}
    first = next(iter(fixes.values()))
    east_per_degree = METRES_PER_DEGREE * np.cos(np.radians(first.lat_deg))
    return {
        i: np.array(
            [
                ((fix.lon_deg - first.lon_deg + 180.0) % 360.0 - 180.0) * east_per_degree,
                (fix.lat_deg - first.lat_deg) * METRES_PER_DEGREE,
            ]
        )
        for i, fix in fixes.items()
    }
