"""Retrieval-guided dynamic subsets (paper Sec. III-C): which images are reconstructed together next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import islice

from ..options import SelectionOptions
from ..records import Neighbour, Subset

Similarity = Callable[[int, int], float]
Support = Callable[[Sequence[int], Sequence[int]], bool]  # (images, references): do these speak for all of those?

STARTS = 8  # best tied images that are tried as the start of a batch


def dominant_references(
    batch: Sequence[int], neighbours: Mapping[int, Sequence[Neighbour]], count: int
) -> tuple[int, ...]:
    """Return the references that most images of a batch share, then those of the highest summed similarity.

    This is D(Q) of Eq. 6 and, for the final batch, R_k of Eq. 8.
    """
    votes: Counter[int] = Counter()
    score: Counter[int] = Counter()
    for query in batch:
        for neighbour in neighbours[query]:
            votes[neighbour.index] += 1
            score[neighbour.index] += neighbour.similarity  # type: ignore[assignment]
    ranked = sorted(votes, key=lambda r: (-votes[r], -score[r], r))
    return tuple(ranked[:count])


def build_subset(
    waiting: Sequence[int],
    neighbours: Mapping[int, Sequence[Neighbour]],
    similarity: Similarity,
    options: SelectionOptions,
    supported: Support = lambda images, references: True,
) -> Subset:
    """Return the next subset B_k = R_k + Q_k (Eq. 8) from the images of the look-ahead, oldest first.

    With a look-ahead of one the batch grows in arrival order and stops at the first image that does not fit, as in
    the paper. A longer look-ahead starts at the image that is best tied to the map and always admits the best
    fitting image within it whose own references stay in the subset (`supported`); of a few such starts the first
    that fills the batch wins, so that shuffled input fills batches too.
    """
    if options.lookahead == 1:
        batch = _grow(waiting, waiting[0], neighbours, similarity, options, supported)
    else:
        best_tied = sorted(waiting, key=lambda q: -_support(neighbours[q]))
        firm = (q for q in best_tied if supported([q], dominant_references([q], neighbours, options.subset_references)))
        batch = []
        for start in list(islice(firm, STARTS)) or best_tied[:1]:
            grown = _grow(waiting, start, neighbours, similarity, options, supported)
            if len(grown) > len(batch):
                batch = grown
            if len(batch) == options.batch_size:
                break
    references = dominant_references(batch, neighbours, options.subset_references)
    return Subset(references=references, new=tuple(batch))


def _grow(
    window: Sequence[int],
    start: int,
    neighbours: Mapping[int, Sequence[Neighbour]],
    similarity: Similarity,
    options: SelectionOptions,
    supported: Support,
) -> list[int]:
    """Return the batch that grows around one image by Eq. 6-7."""
    batch, left = [start], [q for q in window if q != start]
    while left and len(batch) < options.batch_size:
        dominant = set(dominant_references(batch, neighbours, options.references))
        fit = {q: _fit(q, batch, dominant, neighbours, similarity) for q in left}
        ranked = left[:1] if options.lookahead == 1 else sorted(left, key=lambda q: fit[q], reverse=True)
        admitted = (
            q
            for q in ranked
            if fit[q][0] >= options.min_shared_references  # Eq. 7
            and fit[q][1] >= options.min_similarity
            and supported([*batch, q], dominant_references([*batch, q], neighbours, options.subset_references))
        )
        best = next(admitted, None)
        if best is None:
            break
        batch.append(best)
        left.remove(best)
    return batch


def fixed_subset(waiting: Sequence[int], accepted: Sequence[int], options: SelectionOptions) -> Subset:
    """Return the next images as they arrived with the frames placed last: the paper's ablation without Eq. 4-8.

    Args:
        waiting: shot indices in the order of arrival.
        accepted: frames of the map in the order of their acceptance; at least the last `subset_references`.
        options: `batch_size` and `subset_references` count.
    """
    return Subset(tuple(accepted[-options.subset_references :]), tuple(waiting[: options.batch_size]))


def _support(neighbours: Sequence[Neighbour]) -> float:
    return sum(n.similarity for n in neighbours[:3])


def _fit(
    query: int,
    batch: Sequence[int],
    dominant: set[int],
    neighbours: Mapping[int, Sequence[Neighbour]],
    similarity: Similarity,
) -> tuple[int, float]:
    overlap = len({n.index for n in neighbours[query]} & dominant)  # o(q, Q), Eq. 6
    closeness = max(similarity(query, member) for member in batch)  # s_max(q, Q), Eq. 6
    return overlap, closeness
