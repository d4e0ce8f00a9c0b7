"""Local models that are put together afterwards: what chunk-based and divide-and-conquer methods share.

Nothing is validated here: that is what sets these methods apart from the online engine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from onthefly3r.geometry.arrays import Float
from onthefly3r.geometry.transforms import Rigid3, Sim3
from onthefly3r.graph.posegraph import default_solver
from onthefly3r.records import Correspondences, Edge, LocalModel, LocalView, Rejection
from onthefly3r.registration.align import align

LATTICE = (16, 12)  # pixels of a view, across and down, whose points tie it to the same view of another piece
MIN_SHARED = 3  # images


@dataclass(frozen=True)
class Piece:
    """One local model, reduced to its cameras and a lattice of points for each."""

    number: int
    local_from_cam: Mapping[int, Rigid3]
    points: Mapping[int, Float]  # image -> (L, 3) local frame, NaN where nothing trusted is known
    confidence: Mapping[int, Float]  # image -> (L,)


def piece_of(number: int, model: LocalModel, min_confidence: float) -> Piece:
    """Reduce a local model to what tying it to others needs; the same pixels of an image in every piece."""
    points, confidence = {}, {}
    for index, view in model.views.items():
        points[index], confidence[index] = _lattice(view, min_confidence)
    return Piece(number, {i: view.local_from_cam for i, view in model.views.items()}, points, confidence)


def tie(source: Piece, target: Piece) -> Edge | None:
    """Return the Sim(3) from target to source over the images that both hold (Eq. 11), None where it is not known."""
    shared = [i for i in source.local_from_cam if i in target.local_from_cam]
    if len(shared) < MIN_SHARED:
        return None
    local = np.concatenate([target.points[i] for i in shared]).astype(float)
    mapped = np.concatenate([source.points[i] for i in shared]).astype(float)
    weight = np.sqrt(np.concatenate([target.confidence[i] * source.confidence[i] for i in shared]))
    reference = np.repeat(shared, LATTICE[0] * LATTICE[1])
    known = np.isfinite(local).all(axis=1) & np.isfinite(mapped).all(axis=1)
    found = align(Correspondences(local[known], mapped[known], weight[known], reference[known]))
    if isinstance(found, Rejection):
        return None
    return Edge(source.number, target.number, found.map_from_local, found.covariance)


def settle(pieces: Sequence[Piece], edges: Sequence[Edge], root: int) -> dict[int, Sim3]:
    """Return map_from_local of every piece that hangs on `root`: spanning tree first, then the Sim(3) pose graph.

    Edges are given most trusted first: the tree takes each that joins two trees (Kruskal).
    """
    poses = _along(_spanning_tree([piece.number for piece in pieces], edges), root)
    inside = [edge for edge in edges if edge.source in poses]
    has_loops = len(inside) > len(poses) - 1  # more edges than a tree: only then is there anything to balance
    return default_solver().solve_sim3(poses, inside, (), fixed=root) if has_loops else poses


def _spanning_tree(numbers: Sequence[int], edges: Sequence[Edge]) -> dict[int, list[tuple[int, Sim3]]]:
    """Return the neighbours of every piece in the tree, each with number_from_neighbour."""
    tree_of = {number: number for number in numbers}
    neighbours: dict[int, list[tuple[int, Sim3]]] = {number: [] for number in numbers}
    for edge in edges:
        first, second = tree_of[edge.source], tree_of[edge.target]
        if first != second:
            tree_of = {number: first if tree == second else tree for number, tree in tree_of.items()}
            neighbours[edge.source].append((edge.target, edge.source_from_target))
            neighbours[edge.target].append((edge.source, edge.source_from_target.inverse()))
    return neighbours


def _along(neighbours: Mapping[int, Sequence[tuple[int, Sim3]]], root: int) -> dict[int, Sim3]:
    """Return root_from_number of everything that a tree reaches from its root."""
    poses, front = {root: Sim3()}, [root]
    while front:
        number = front.pop()
        for other, number_from_other in neighbours[number]:
            if other not in poses:
                poses[other] = poses[number] @ number_from_other
                front.append(other)
    return poses


def cameras(pieces: Iterable[Piece], map_from_piece: Mapping[int, Sim3], owner: Mapping[int, int]) -> dict[int, Rigid3]:
    """Return map_from_cam of every image whose owner, a piece, has a place."""
    by_number = {piece.number: piece for piece in pieces}
    return {
        image: map_from_piece[number].apply_to_pose(by_number[number].local_from_cam[image])
        for image, number in owner.items()
        if number in map_from_piece and image in by_number[number].local_from_cam
    }


def _lattice(view: LocalView, min_confidence: float) -> tuple[Float, Float]:
    height, width = view.confidence.shape
    columns = ((np.arange(LATTICE[0]) + 0.5) * width / LATTICE[0]).astype(int)
    rows = ((np.arange(LATTICE[1]) + 0.5) * height / LATTICE[1]).astype(int)
    at = np.ix_(rows, columns)
    confidence = view.confidence[at].reshape(-1)
    points = view.points[at].reshape(-1, 3)
    return np.where((confidence >= min_confidence)[:, None], points, np.nan), confidence
