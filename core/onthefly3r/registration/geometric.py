"""Geometric pruning: drop the references that contradict the others, worst first, without a new inference."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..geometry.transforms import Rigid3
from ..records import Alignment, Correspondences, LocalModel, Rejection
from .align import align
from .validate import ReferenceVerdict, pose_residuals


def only(pairs: Correspondences, references: tuple[int, ...]) -> Correspondences:
    """Return the correspondences of some references."""
    kept = np.isin(pairs.reference, references)
    return Correspondences(pairs.local[kept], pairs.map[kept], pairs.weight[kept], pairs.reference[kept])


def prune_references(
    model: LocalModel,
    pairs: Correspondences,
    map_from_cam: Mapping[int, Rigid3],
    min_references: int,
    validate: Callable[[Alignment], ReferenceVerdict],
) -> tuple[Alignment, ReferenceVerdict] | Rejection:
    """Drop references one by one until the rest passes `validate`, or fewer than `min_references` remain.

    One Sim(3) per reference (paper Sec. III-E) tells how well each agrees with each other one; the reference
    whose median disagreement is largest goes first.
    """
    remaining = tuple(int(i) for i in np.unique(pairs.reference))
    disagreement: dict[tuple[int, int], float] = {}
    verdict: ReferenceVerdict | None = None
    while len(remaining) >= max(min_references, 1):
        alignment = align(only(pairs, remaining))
        if isinstance(alignment, Rejection):
            return alignment
        verdict = validate(alignment)
        if verdict.passed:
            return alignment, verdict
        disagreement = disagreement or _disagreement(model, pairs, map_from_cam, remaining)
        remaining = _without_worst(remaining, disagreement)
    numbers = {"references": float(len(np.unique(pairs.reference)))}
    if verdict is not None:
        numbers["median_shift"] = float(np.median([r.translation for r in verdict.residuals]))
        numbers["median_rotation_deg"] = float(np.median([r.rotation_deg for r in verdict.residuals]))
    return Rejection((), "references", verdict.reason if verdict else "too few references", numbers)


def _disagreement(
    model: LocalModel, pairs: Correspondences, map_from_cam: Mapping[int, Rigid3], references: tuple[int, ...]
) -> dict[tuple[int, int], float]:
    """Shift of reference s under the Sim(3) of reference r alone, for all ordered pairs; infinite when unknown."""
    shift = {}
    for r in references:
        alone = align(only(pairs, (r,)))
        if isinstance(alone, Rejection):
            shift.update({(r, s): np.inf for s in references if s != r})
            continue
        others = tuple(s for s in references if s != r)
        for residual in pose_residuals(model, alone.map_from_local, map_from_cam, others):
            shift[r, residual.index] = residual.translation
    return shift


def _without_worst(remaining: tuple[int, ...], disagreement: Mapping[tuple[int, int], float]) -> tuple[int, ...]:
    def badness(r: int) -> float:
        return float(np.median([disagreement[r, s] + disagreement[s, r] for s in remaining if s != r] or [np.inf]))

    worst = max(remaining, key=badness)
    return tuple(r for r in remaining if r != worst)
