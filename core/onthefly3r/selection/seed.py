"""The seed: N0 retrieval-connected images (paper Sec. III-B), the best-connected blob or the first that arrived."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..geometry.arrays import Float

CONNECTING_NEIGHBOURS = 5
MAX_STARTS = 200  # of many images, so many evenly spread ones are looked at as starts


def choose_seed(
    candidates: Sequence[int],
    similarities: Callable[[Sequence[int], Sequence[int]], Float],
    size: int,
    avoid: frozenset[int],
    is_copy: Callable[[int, int], bool] | None = None,
) -> tuple[int, ...]:
    """Return up to `size` candidates that are mutually similar, in the order in which they joined.

    The blob starts at the image whose nearest neighbours are most similar to it and always takes the image most
    similar to what it holds already, so that it covers crossing strips rather than one line of flight. Empty when
    every start was tried before.

    Args:
        candidates: shot indices.
        similarities: (first, second) -> similarities (Eq. 4) of all pairs.
        size: N0.
        avoid: starts that were tried before and refused.
        is_copy: whether two images are nearly the same picture; of those only one joins, since the seed lives on
            parallax.
    """
    starts = [i for i, candidate in enumerate(candidates) if candidate not in avoid]
    if not starts:
        return ()
    neighbours = min(CONNECTING_NEIGHBOURS, len(candidates) - 1)
    if neighbours < 1:
        return tuple(candidates)
    if len(starts) > MAX_STARTS:
        starts = [starts[i] for i in np.linspace(0, len(starts) - 1, MAX_STARTS).astype(int)]
    affinity = similarities([candidates[i] for i in starts], candidates)
    affinity[np.arange(len(starts)), starts] = -np.inf
    density = np.partition(affinity, -neighbours, axis=1)[:, -neighbours:].mean(axis=1)
    chosen = [starts[int(np.argmax(density))]]
    copies: set[int] = set()
    links = np.zeros((len(candidates), neighbours))  # the best ones of each candidate to the blob
    links = np.sort(np.column_stack([links, similarities(candidates, [candidates[chosen[0]]])]), axis=1)[:, 1:]
    while len(chosen) < min(size, len(candidates)):
        # Few links count less: an image must hang on several members, not on one.
        attraction = links.sum(axis=1)
        attraction[chosen] = -np.inf
        attraction[list(copies)] = -np.inf
        best = int(np.argmax(attraction))
        if not np.isfinite(attraction[best]):
            break
        if is_copy is not None and any(is_copy(candidates[best], candidates[i]) for i in chosen):
            copies.add(best)
            continue
        chosen.append(best)
        new = similarities(candidates, [candidates[best]])
        links = np.sort(np.column_stack([links, new]), axis=1)[:, 1:]
    return tuple(candidates[i] for i in chosen)


def choose_first_seed(
    candidates: Sequence[int],
    similarities: Callable[[Sequence[int], Sequence[int]], Float],
    size: int,
    avoid: frozenset[int],
    is_copy: Callable[[int, int], bool] | None = None,
) -> tuple[int, ...]:
    """Return the first `size` candidates that retrieval connects, in their order: the paper's seed (Sec. III-B).

    It begins at the first candidate and always takes the earliest one that is among the nearest neighbours of an
    image that it holds. Where a group ends before it has `size` images, later groups are tried; the largest is
    returned if none has enough.

    Args:
        candidates: shot indices in order of arrival.
        similarities: (first, second) -> similarities (Eq. 4) of all pairs.
        size: N0.
        avoid: starts that were tried before and refused.
        is_copy: whether two images are nearly the same picture; of those only the first joins.
    """
    count = min(CONNECTING_NEIGHBOURS, len(candidates) - 1)
    wanted = min(size, len(candidates))
    best: list[int] = []
    looked_at: set[int] = set()
    for start in range(len(candidates)):
        if start in looked_at or candidates[start] in avoid:
            continue
        group: list[int] = []
        reached = {start}
        passed: set[int] = set()  # copies of what the group holds, and members
        while reached - passed and len(group) < wanted:
            row = min(reached - passed)
            passed.add(row)
            if is_copy is not None and any(is_copy(candidates[row], candidates[member]) for member in group):
                continue
            group.append(row)
            affinity = similarities([candidates[row]], candidates)[0]
            affinity[row] = -np.inf
            reached |= set(np.argpartition(affinity, -count)[-count:].tolist() if count else [])
        looked_at |= passed
        if len(group) > len(best):
            best = group
        if len(best) == wanted:
            break
    return tuple(candidates[row] for row in sorted(best))


def hanging_together(
    seed: tuple[int, ...], candidates: Sequence[int], similarities: Callable[[Sequence[int], Sequence[int]], Float]
) -> tuple[int, ...]:
    """Return the images of a seed that mutual nearest neighbours link to its first one, in their order.

    A blob takes the size that is asked for, even where its images are of several places.
    """
    neighbours = min(CONNECTING_NEIGHBOURS, len(candidates) - 1)
    if not seed or neighbours < 1:
        return seed
    affinity = similarities(seed, candidates)
    column = {index: k for k, index in enumerate(candidates)}
    own = np.array([column[index] for index in seed])
    affinity[np.arange(len(seed)), own] = -np.inf
    least = np.partition(affinity, -neighbours, axis=1)[:, -neighbours]
    near = affinity[:, own] >= least[:, None]
    linked = near & near.T
    reached = np.zeros(len(seed), bool)
    reached[0] = True
    for _ in seed:
        reached = reached | linked[reached].any(axis=0)
    return tuple(index for index, is_reached in zip(seed, reached, strict=True) if is_reached)
