"""Retrieval: the incremental table must answer as a plain matrix product does."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.records import GpsFix
from onthefly3r.selection import index as index_module
from onthefly3r.selection.index import RetrievalIndex
from onthefly3r.selection.proposals import plane_position, propose_references


def unit_rows(count: int, length: int = 24, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((count, length)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return np.trunc(rows * 4096) / 4096  # what the table keeps of them


def filled(vectors: np.ndarray, accepted: list[int]) -> RetrievalIndex:
    index = RetrievalIndex()
    for i, vector in enumerate(vectors):
        index.add(10 * i, vector)  # shot indices are not rows
    index.accept([10 * i for i in accepted])
    return index


def test_top_is_exact_and_best_first() -> None:
    vectors, accepted = unit_rows(200), list(range(0, 200, 3))
    found = filled(vectors, accepted).top([10, 1990], 5)
    for query in (10, 1990):
        similarity = vectors[accepted] @ vectors[query // 10]
        best = [10 * accepted[i] for i in np.argsort(-similarity)[:5]]
        assert [n.index for n in found[query]] == best
        np.testing.assert_allclose([n.similarity for n in found[query]], np.sort(similarity)[::-1][:5], rtol=1e-5)


def test_an_image_is_not_its_own_neighbour_and_few_frames_give_few_neighbours() -> None:
    index = filled(unit_rows(6), [0, 1, 2])
    assert {n.index for n in index.top([0], 5)[0]} == {10, 20}
    assert filled(unit_rows(6), []).top([30], 5) == {30: []}


@pytest.mark.parametrize("kept", [256, 2])
def test_what_arrives_later_is_found_too(monkeypatch: pytest.MonkeyPatch, kept: int) -> None:
    """The kept similarity rows grow with the table; dropping them changes nothing but time."""
    monkeypatch.setattr(index_module, "KEPT_ROWS", kept)
    vectors = unit_rows(150)
    at_once, one_by_one = filled(vectors, list(range(100))), RetrievalIndex()
    queries = [10 * i for i in range(100, 110)]
    for i, vector in enumerate(vectors[:110]):
        one_by_one.add(10 * i, vector)
    for i in range(0, 100, 5):
        one_by_one.accept([10 * k for k in range(i, i + 5)])
        one_by_one.top(queries, 3)
    for i in range(110, 150):
        one_by_one.add(10 * i, vectors[i])
    for index in (at_once, one_by_one):
        index.accept([10 * i for i in range(115, 150)])
    for query, found in at_once.top(queries, 5).items():
        again = one_by_one.top(queries, 5)[query]
        assert [n.index for n in again] == [n.index for n in found]
        np.testing.assert_allclose([n.similarity for n in again], [n.similarity for n in found], atol=1e-6)
    assert len(one_by_one._similar) <= kept


@pytest.mark.parametrize(("first", "second"), [(3, 120), (120, 3), (4, 4), (120, 120)])
def test_similarities_of_all_pairs(first: int, second: int) -> None:
    vectors = unit_rows(120)
    index = filled(vectors, [])
    rows, columns = list(range(first))[::-1], list(range(second))
    result = index.similarities([10 * i for i in rows], [10 * i for i in columns])
    np.testing.assert_allclose(result, vectors[rows] @ vectors[columns].T, atol=1e-6)


def test_similarities_do_not_depend_on_how_they_are_asked_for() -> None:
    """Of long descriptors, two of them alike, to the last bit: in blocks, one by one, and by another product."""
    vectors = unit_rows(90, 8192)
    vectors[1] = vectors[0]
    index = filled(vectors, [])
    images = [10 * i for i in range(90)]
    every = index.similarities(images, images)
    exact = vectors.astype(float) @ vectors.astype(float).T
    np.testing.assert_array_equal(every, exact)
    for i in (0, 1, 37):
        for columns in (images, images[3:17], images[40:41]):
            one = index.similarities([10 * i], columns)
            np.testing.assert_array_equal(one, exact[i : i + 1, [c // 10 for c in columns]])


@pytest.mark.parametrize("late", [False, True])
def test_best_tied_are_those_most_like_some_frame_of_the_map(late: bool) -> None:
    vectors, accepted = unit_rows(90), list(range(30))
    index = filled(vectors[:60] if late else vectors, accepted[:20])
    for i in range(60, 90):
        if late:
            index.add(10 * i, vectors[i])
    index.accept([10 * i for i in accepted[20:]])
    waiting = list(range(89, 29, -1))
    tie = (vectors[waiting] @ vectors[accepted].T).max(axis=1)
    expected = {10 * waiting[i] for i in np.argsort(-tie)[:12]}
    chosen = index.best_tied([10 * i for i in waiting], 12)
    assert set(chosen) == expected
    assert chosen == sorted(chosen, reverse=True)  # in the order given
    assert index.best_tied([500, 400], 12) == [500, 400]


def test_contains_and_length() -> None:
    index = filled(unit_rows(3), [])
    assert len(index) == 3 and 20 in index and 2 not in index


def positioned(positions: list[tuple[float, float] | None]) -> RetrievalIndex:
    index = RetrievalIndex()
    for i, (vector, position) in enumerate(zip(unit_rows(len(positions)), positions, strict=True)):
        index.add(i, vector, None if position is None else np.array(position))
    return index


def test_nearest_by_position_skips_images_without_one() -> None:
    index = positioned([(0, 0), (30, 0), None, (10, 0), (20, 0), None])
    index.accept([1, 2, 3, 4])
    assert [n.index for n in index.nearest(0, 2)] == [3, 4]
    assert [n.index for n in index.nearest(3, 5)] == [4, 1]  # not itself
    assert index.nearest(5, 2) == []
    assert index.nearest(0, 1)[0].similarity == pytest.approx(float(unit_rows(6)[0] @ unit_rows(6)[3]), abs=1e-6)


def test_positions_add_candidates_and_take_none_away() -> None:
    index = positioned([(float(10 * i), 0.0) for i in range(30)])
    index.accept(list(range(20)))
    retrieved = index.top([25], 5)[25]
    with_positions = propose_references([25], index, 5, use_positions=True)[25]
    assert with_positions[:5] == retrieved == propose_references([25], index, 5, use_positions=False)[25]
    numbers = [n.index for n in with_positions]
    assert set(numbers) == {n.index for n in retrieved} | {15, 16, 17, 18, 19}
    assert len(numbers) == len(set(numbers))


def test_plane_position_in_metres_and_across_the_date_line() -> None:
    origin = GpsFix(60.0, 179.999, None)
    east, north = plane_position(GpsFix(60.001, -179.999, None), origin)
    assert east == pytest.approx(0.002 * 111_320 * 0.5, rel=1e-3)
    assert north == pytest.approx(111.3, rel=1e-3)
