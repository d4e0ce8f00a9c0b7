"""Interleaved parts of a visual order, reconstructed apart and merged by shared images: the partition of MERG3R.

L. K. Cheng et al., "MERG3R: A Divide-and-Conquer Approach to Large-Scale Neural Visual Geometry", CVPR 2026. A
Hamiltonian path through the graph of similarities orders the images, interleaved sampling makes every part span the
whole path, and windows over the sampled order overlap, which ties one part to the next. Theirs orders by DINO features
and ends with a bundle adjustment over all images, which not every backbone here could do.
"""

from __future__ import annotations

import numpy as np

from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.selection.index import RetrievalIndex

from .partition import GUESTS, Infer, merge


def place_interleaved(
    n_images: int, index: RetrievalIndex, infer: Infer, min_confidence: float, limit: int
) -> dict[int, Rigid3]:
    """Return map_from_cam of the images 0..n-1; `limit` is the most images of one inference."""
    return merge(interleaved_windows(hamiltonian_order(n_images, index), limit), infer, min_confidence)


def hamiltonian_order(n_images: int, index: RetrievalIndex) -> list[int]:
    """Return a path through all images that always goes on to the most similar one that is left.

    It begins at the image that is least like all others, which lies at a border.
    """
    if n_images == 0:
        return []
    images = list(range(n_images))
    start = int(np.argmin([index.similarities([i], images).sum() for i in images]))
    path, left = [start], np.ones(n_images, bool)
    left[start] = False
    while left.any():
        similarity = np.where(left, index.similarities([path[-1]], images)[0], -np.inf)
        path.append(int(np.argmax(similarity)))
        left[path[-1]] = False
    return path


def interleaved_windows(path: list[int], limit: int) -> list[tuple[list[int], list[int]]]:
    """Return for each part its own images and the first ones of the next part, which it borrows.

    Of K parts the k-th has the images k, k + K, k + 2 K ... of the path.
    """
    if len(path) <= limit:
        return [(path, [])]
    own = round(limit * (1.0 - GUESTS))
    count = -(-len(path) // own)
    sampled = [path[k::count] for k in range(count)]
    following = [*sampled[1:], sampled[0]]  # the last borrows of the first: the windows close a ring
    return [(part, after[: limit - len(part)]) for part, after in zip(sampled, following, strict=True)]
