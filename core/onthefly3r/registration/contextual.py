"""Contextual pruning: drop the references whose context tokens do not fit the new images, then infer once more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.arrays import Float
from ..records import LocalView, Subset

OUTLIER_Z = 2.0


def incompatible_references(subset: Subset, views: Mapping[int, LocalView], min_references: int) -> tuple[int, ...]:
    """Return the references to drop, least compatible first, leaving at least `min_references`.

    A reference is incompatible when its mean token distance (1 - cosine) to the new images stands out from the
    other references by `OUTLIER_Z` robust standard deviations (paper Sec. III-E, contextual pruning).
    Empty when the backbone gives no tokens.
    """
    references = [i for i in subset.references if i in views and views[i].tokens is not None]
    new = [i for i in subset.new if i in views and views[i].tokens is not None]
    spare = len(references) - min_references
    if not new or spare <= 0:
        return ()
    distance = 1.0 - _unit_tokens(views, references) @ _unit_tokens(views, new).T
    mean_distance = distance.mean(axis=1)
    middle = np.median(mean_distance)
    spread = 1.4826 * np.median(np.abs(mean_distance - middle)) + 1e-6
    score = (mean_distance - middle) / spread
    worst_first = np.argsort(-score)[:spare]
    return tuple(references[i] for i in worst_first if score[i] >= OUTLIER_Z)


def _unit_tokens(views: Mapping[int, LocalView], indices: list[int]) -> Float:
    tokens = np.array([views[i].tokens for i in indices], float)
    return np.asarray(tokens / np.maximum(np.linalg.norm(tokens, axis=1, keepdims=True), 1e-12))
