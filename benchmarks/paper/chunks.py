"""Overlapping chunks in order of arrival, aligned one to the next, with loop closure: the idea of VGGT-Long.

K. Deng et al., "VGGT-Long: Chunk it, Loop it, Align it", ICRA 2026. Chunks overlap by half. Images of chunks that are
no neighbours but look alike are reconstructed together once more, which ties the two chunks by a loop. DA3-Streaming
does the same with another network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from onthefly3r.geometry.arrays import Float
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.records import LocalModel
from onthefly3r.selection.index import RetrievalIndex

from .pieces import Piece, cameras, piece_of, settle, tie


@dataclass(frozen=True)
class ChunkSettings:
    """Sizes in images; chunks overlap by half."""

    chunk: int
    loop_half: int  # consecutive images about each of the two that look alike; a loop call holds twice as many
    loop_similarity: float  # cosine from which two images are taken for the same place


FITTING = ChunkSettings(chunk=58, loop_half=11, loop_similarity=0.6)  # the memory and the descriptors of our tables
PUBLISHED = ChunkSettings(chunk=60, loop_half=20, loop_similarity=0.85)  # the last one for another descriptor

Infer = Callable[[Sequence[int]], LocalModel | None]


def place_chunks(
    n_images: int, index: RetrievalIndex, infer: Infer, min_confidence: float, settings: ChunkSettings
) -> dict[int, Rigid3]:
    """Return map_from_cam of the images 0..n-1."""
    pieces: list[Piece] = []
    windows = chunk_windows(n_images, settings.chunk)
    for window in windows:
        model = infer(window)
        if model is not None:
            pieces.append(piece_of(len(pieces), model, min_confidence))
        else:
            pieces.append(Piece(len(pieces), {}, {}, {}))  # keeps its number: the chain is broken here
    chain = [tie(before, after) for before, after in pairwise(pieces)]
    loops = []
    similarity = index.similarities(range(n_images), range(n_images))
    for a, b in find_loops(windows, similarity, settings.loop_similarity):
        nearby = {*_around(a, n_images, settings.loop_half), *_around(b, n_images, settings.loop_half)}
        model = infer(sorted(nearby))
        if model is not None:
            loop = piece_of(len(pieces), model, min_confidence)
            pieces.append(loop)
            loops += [tie(pieces[owner], loop) for owner in (_owner(a, windows), _owner(b, windows))]
    edges = [edge for edge in [*chain, *loops] if edge is not None]
    return cameras(pieces, settle(pieces, edges, root=0), {i: _owner(i, windows) for i in range(n_images)})


def chunk_windows(n_images: int, size: int) -> list[range]:
    """Return windows of at most `size` images, each overlapping the one before by half."""
    step = max(1, size // 2)
    starts = range(0, max(1, n_images - step), step)
    return [range(start, min(start + size, n_images)) for start in starts]


def find_loops(windows: Sequence[range], similarity: Float, least: float) -> list[tuple[int, int]]:
    """Return the most similar pair of images (a < b) of every two chunks that are no neighbours and look alike.

    similarity (N, N): cosines of all images in order of arrival; pairs below `least` do not look alike.
    """
    owners = np.array([_owner(i, windows) for i in range(len(similarity))])
    best: dict[tuple[int, int], tuple[float, int, int]] = {}
    first, second = np.nonzero(np.triu(similarity >= least, k=1))
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        pair = (int(owners[a]), int(owners[b]))
        if abs(pair[0] - pair[1]) < 2:
            continue
        found = (float(similarity[a, b]), a, b)
        if pair not in best or found > best[pair]:
            best[pair] = found
    return [(a, b) for _, a, b in best.values()]


def _owner(image: int, windows: Sequence[range]) -> int:
    """The first chunk that holds an image."""
    return next(number for number, window in enumerate(windows) if image in window)


def _around(image: int, n_images: int, count: int) -> range:
    """So many consecutive images, fewer at the ends, the image in their middle."""
    start = image - count // 2
    return range(max(0, start), min(n_images, start + count))
