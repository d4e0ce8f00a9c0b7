from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from onthefly3r.selection import seed as seed_module
from onthefly3r.selection.seed import choose_first_seed, choose_seed, hanging_together


class Plane:
    """Images at places of a plane; similarity falls with the distance."""

    def __init__(self, places: np.ndarray) -> None:
        self.places = places

    def __call__(self, first: Sequence[int], second: Sequence[int]) -> np.ndarray:
        offsets = self.places[list(first)][:, None] - self.places[list(second)][None]
        return np.exp(-0.5 * (offsets**2).sum(axis=-1))


def grid(columns: int, rows: int, spacing: float = 0.7) -> np.ndarray:
    return spacing * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)


def test_a_seed_is_one_blob_and_not_a_line() -> None:
    places = grid(20, 6)
    chosen = choose_seed(range(120), Plane(places), 24, frozenset())
    assert len(set(chosen)) == 24
    extent = np.ptp(places[list(chosen)], axis=0) / 0.7
    assert extent.max() <= 9 and extent.min() >= 2  # 24 images of one strip would be 23 long


def test_a_seed_avoids_loners_and_small_groups() -> None:
    places = np.vstack([[[100.0, 0.0]], grid(2, 1) + 50.0, grid(8, 4)])
    chosen = choose_seed(range(len(places)), Plane(places), 10, frozenset())
    assert min(chosen) >= 3


def test_refused_starts_are_not_tried_again() -> None:
    places = np.vstack([grid(5, 2), grid(5, 2, 0.9) + 40.0])
    first = choose_seed(range(20), Plane(places), 5, frozenset())
    assert set(first) <= set(range(10))  # the denser group
    refused = frozenset(range(10))
    assert choose_seed(range(20), Plane(places), 5, refused)[0] >= 10
    assert choose_seed(range(20), Plane(places), 5, frozenset(range(20))) == ()


def test_few_candidates_are_all_taken() -> None:
    assert sorted(choose_seed([4, 7, 9], Plane(grid(10, 1)), 30, frozenset())) == [4, 7, 9]
    assert choose_seed([4], Plane(grid(10, 1)), 30, frozenset()) == (4,)
    assert choose_seed([], Plane(grid(10, 1)), 30, frozenset()) == ()


def test_of_many_images_only_some_are_looked_at_as_starts() -> None:
    asked: list[int] = []
    plane = Plane(grid(100, 10))

    def similarities(first: Sequence[int], second: Sequence[int]) -> np.ndarray:
        asked.append(min(len(first), len(second)))
        return plane(first, second)

    assert len(choose_seed(range(1000), similarities, 10, frozenset())) == 10
    assert asked[0] == seed_module.MAX_STARTS and set(asked[1:]) == {1}


def test_the_papers_seed_is_the_first_images_that_hang_together() -> None:
    dense = np.vstack([grid(20, 1), grid(8, 8, 0.2) + 50.0])
    assert min(choose_seed(range(84), Plane(dense), 12, frozenset())) >= 20
    assert choose_first_seed(range(84), Plane(dense), 12, frozenset()) == tuple(range(12))


def test_the_papers_seed_leaves_out_what_arrives_in_between_from_elsewhere() -> None:
    places = np.zeros((40, 2))
    places[::2], places[1::2] = grid(20, 1), grid(20, 1) + 50.0  # two drones in turn
    assert choose_first_seed(range(40), Plane(places), 12, frozenset()) == tuple(range(0, 24, 2))


def test_the_papers_seed_passes_over_groups_that_are_too_small_and_starts_that_were_refused() -> None:
    places = np.vstack([grid(6, 1) + 90.0, grid(20, 1)])
    assert choose_first_seed(range(26), Plane(places), 12, frozenset()) == tuple(range(6, 18))
    assert choose_first_seed(range(26), Plane(places), 12, frozenset(range(8)))[0] in (6, 8)
    assert choose_first_seed(range(6), Plane(places), 12, frozenset()) == tuple(range(6))
    assert choose_first_seed([], Plane(places), 12, frozenset()) == ()
    assert choose_first_seed(range(26), Plane(places), 12, frozenset(range(26))) == ()


def test_the_papers_seed_takes_one_of_two_copies() -> None:
    places = np.repeat(grid(20, 1), 2, axis=0)
    chosen = choose_first_seed(range(40), Plane(places), 8, frozenset(), lambda a, b: a // 2 == b // 2)
    assert len({i // 2 for i in chosen}) == 8


def test_an_empty_seed_stays_empty() -> None:
    assert hanging_together((), range(5), lambda a, b: np.zeros((len(a), len(b)))) == ()
