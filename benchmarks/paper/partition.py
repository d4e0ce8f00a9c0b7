"""Graph cuts: compact parts of the retrieval graph, reconstructed apart and merged by the images they share.

No published method: divide and conquer as one would build it for aerial surveys, as a measure for the others (MERG3R's
partition is in `interleaved.py`). The graph of most similar images is halved until a part fits one inference; a part
then borrows the images nearest to it from its neighbours, which ties it to them. Arrival order does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from onthefly3r.geometry.arrays import Int
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.records import LocalModel
from onthefly3r.selection.index import RetrievalIndex

from .pieces import MIN_SHARED, Piece, cameras, piece_of, settle, tie

NEIGHBOURS = 10  # edges of an image in the retrieval graph
BLOCK = 1000  # rows of the similarity matrix at a time
GUESTS = 1 / 3  # share of an inference that is borrowed from other parts

Infer = Callable[[Sequence[int]], LocalModel | None]


def place_parts(
    n_images: int, index: RetrievalIndex, infer: Infer, min_confidence: float, limit: int
) -> dict[int, Rigid3]:
    """Return map_from_cam of the images 0..n-1; `limit` is the most images of one inference."""
    graph = retrieval_graph(n_images, index)
    parts = halve(graph, np.arange(n_images), round(limit * (1.0 - GUESTS)))
    calls = [(part.tolist(), guests(graph, part, limit - len(part))) for part in parts]
    return merge(calls, infer, min_confidence)


def merge(calls: Sequence[tuple[list[int], list[int]]], infer: Infer, min_confidence: float) -> dict[int, Rigid3]:
    """Return map_from_cam of the images of all parts: each is inferred with its guests, then all are merged.

    calls: for each part its own images and those that it borrows.
    """
    pieces: list[Piece] = []
    owner: dict[int, int] = {}
    for part, borrowed in calls:
        model = infer([*part, *borrowed])
        if model is not None:
            owner |= {i: len(pieces) for i in part}
            pieces.append(piece_of(len(pieces), model, min_confidence))
    if not pieces:
        return {}
    edges = [edge for a, b in shared_most(pieces) if (edge := tie(pieces[a], pieces[b])) is not None]
    root = max(pieces, key=lambda piece: len(piece.local_from_cam)).number
    return cameras(pieces, settle(pieces, edges, root), owner)


def retrieval_graph(n_images: int, index: RetrievalIndex) -> Any:
    """Return the symmetric sparse (N, N) matrix of the similarities of every image to its nearest ones."""
    from scipy.sparse import coo_matrix

    images = np.arange(n_images)
    count = min(NEIGHBOURS, n_images - 1)
    nearest, weights = [], []
    for block in np.array_split(images, -(-n_images // BLOCK)):
        similarity = index.similarities(block.tolist(), images.tolist())
        similarity[np.arange(len(block)), block] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
        nearest.append(best)
        weights.append(np.maximum(np.take_along_axis(similarity, best, axis=1), 1e-6))
    rows = np.repeat(images, count)
    entries = (np.concatenate(weights).ravel(), (rows, np.concatenate(nearest).ravel()))
    directed = coo_matrix(entries, shape=(n_images, n_images)).tocsr()
    return directed.maximum(directed.T).tocsr()


def halve(graph: Any, members: Int, size: int) -> list[Int]:
    """Cut a set of images along the weakest links into equal halves until every part has at most `size`.

    Unconnected images are parted first; the halves follow the Fiedler vector of the normalised Laplacian.
    """
    from scipy.sparse.csgraph import connected_components

    if len(members) <= size:
        return [members]
    inside = graph[members][:, members]
    count, label = connected_components(inside, directed=False)
    if count > 1:
        return [part for k in range(count) for part in halve(graph, members[label == k], size)]
    order = np.argsort(_fiedler(inside), kind="stable")
    middle = len(members) // 2
    return [*halve(graph, members[order[:middle]], size), *halve(graph, members[order[middle:]], size)]


def guests(graph: Any, part: Int, count: int) -> list[int]:
    """Return at most `count` images outside a part, those tied to it most strongly."""
    strength = np.asarray(graph[part].sum(axis=0)).ravel()
    strength[part] = 0.0
    best = np.argsort(-strength, kind="stable")[:count]
    return [int(i) for i in best if strength[i] > 0.0]


def shared_most(pieces: Sequence[Piece]) -> list[tuple[int, int]]:
    """Return the pairs of pieces that share enough images, those that share most first."""
    holders: dict[int, list[int]] = {}
    for piece in pieces:
        for image in piece.local_from_cam:
            holders.setdefault(image, []).append(piece.number)
    shared: dict[tuple[int, int], int] = {}
    for numbers in holders.values():
        for k, a in enumerate(numbers):
            for b in numbers[k + 1 :]:
                shared[a, b] = shared.get((a, b), 0) + 1
    enough = [pair for pair, count in shared.items() if count >= MIN_SHARED]
    return sorted(enough, key=lambda pair: (-shared[pair], pair))


def _fiedler(weights: Any) -> Any:
    """Return the eigenvector (N,) of the second smallest eigenvalue of the normalised Laplacian."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import eigsh

    root = 1.0 / np.sqrt(np.asarray(weights.sum(axis=1)).ravel())
    normalised = diags(root) @ weights @ diags(root)  # its largest eigenvalues are the Laplacian's smallest
    start = np.random.default_rng(0).random(weights.shape[0])
    values, vectors = eigsh(normalised, k=2, which="LA", v0=start)
    return vectors[:, np.argmin(values)] * root
