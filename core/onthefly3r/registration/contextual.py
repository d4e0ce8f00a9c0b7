"""Contextual pruning: drop the references whose context tokens do not fit the new images, then infer once more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.arrays import Float
from ..records import LocalView, Subset

OUTLIER_Z = 2.0
# The new images of a subset are few: their own distances tell their spread no better than to this share.
LEAST_SPREAD = 0.5
ROUNDING = 1e-6  # distances below it are no measure of anything


def incompatible_references(subset: Subset, views: Mapping[int, LocalView], min_references: int) -> tuple[int, ...]:
    """Return the references to drop, least compatible first, leaving at least `min_references`.

    A reference is incompatible when its usual token distance (1 - cosine) to the new images exceeds what these have
    among themselves by `OUTLIER_Z` robust standard deviations (paper Sec. III-E, contextual pruning). The other
    references are no measure: most of them may be wrong. A single new image has only the reference nearest to it to
    compare with. Empty when the backbone gives no tokens.
    """
    references = [i for i in subset.references if i in views and views[i].tokens is not None]
    new = [i for i in subset.new if i in views and views[i].tokens is not None]
    spare = len(references) - min_references
    if not new or spare <= 0:
        return ()
    new_tokens = _unit_tokens(views, new)
    distance = _lower_median(1.0 - _unit_tokens(views, references) @ new_tokens.T)
    own = distance.min(keepdims=True)
    if len(new) > 1:
        to_others = 1.0 - new_tokens @ new_tokens.T
        own = _lower_median(to_others[~np.eye(len(new), dtype=bool)].reshape(len(new), -1))
    middle = float(_lower_median(own))
    spread = max(1.4826 * float(_lower_median(np.abs(own - middle))), LEAST_SPREAD * middle, ROUNDING)
    score = (distance - middle) / spread
    worst_first = np.argsort(-score)[:spare]
    return tuple(references[i] for i in worst_first if score[i] >= OUTLIER_Z)


def _lower_median(values: Float) -> Float:
    """Return the lower median along the last axis: of an even number, as many must be bad as good to spoil it."""
    return np.asarray(np.sort(values, axis=-1)[..., (values.shape[-1] - 1) // 2])


def _unit_tokens(views: Mapping[int, LocalView], indices: list[int]) -> Float:
    tokens = np.array([views[i].tokens for i in indices], float)
    return np.asarray(tokens / np.maximum(np.linalg.norm(tokens, axis=1, keepdims=True), 1e-12))
