"""The seed: N0 retrieval-connected images (paper Sec. III-B), grown as one blob around its best-connected image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.arrays import Float

CONNECTING_NEIGHBOURS = 5


def choose_seed(candidates: Sequence[int], affinity: Float, size: int, avoid: frozenset[int]) -> tuple[int, ...]:
    """Return up to `size` candidates that are mutually similar, in the order in which they joined.

    The blob starts at the image whose nearest neighbours are most similar to it and always takes the image most
    similar to what it holds already, so that it covers crossing strips rather than one line of flight.

    Args:
        candidates: shot indices.
        affinity: (N, N) similarities of the candidates (Eq. 4, with whatever position adds).
        size: N0.
        avoid: starts that were tried before and refused.
    """
    similarity = np.array(affinity, float)
    np.fill_diagonal(similarity, -np.inf)
    neighbours = min(CONNECTING_NEIGHBOURS, len(candidates) - 1)
    if neighbours < 1:
        return tuple(candidates)
    density = np.sort(similarity, axis=1)[:, -neighbours:].mean(axis=1)
    density[[i for i, c in enumerate(candidates) if c in avoid]] = -np.inf
    chosen = [int(np.argmax(density))]
    if not np.isfinite(density[chosen[0]]):
        return ()
    while len(chosen) < min(size, len(candidates)):
        links = np.sort(similarity[:, chosen], axis=1)[:, -neighbours:]
        # Few links count less: an image must hang on several members, not on one.
        attraction = np.maximum(links, 0.0).sum(axis=1)
        attraction[chosen] = -np.inf
        chosen.append(int(np.argmax(attraction)))
    return tuple(candidates[i] for i in chosen)
