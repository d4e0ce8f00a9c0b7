"""Bursts of one place: near copies are told from photographs with parallax, and only one of them joins the seed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from onthefly3r.selection.nearcopies import NearCopies
from onthefly3r.selection.seed import choose_seed

GROUND = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (900, 1600, 3), dtype=np.uint8), (0, 0), 6.0)
GROUND = cv2.normalize(GROUND, None, 0, 255, cv2.NORM_MINMAX)


def view(across: int, down: int = 0, noise: float = 4.0) -> np.ndarray:
    """A window of 600 x 450 on the ground, with the noise of a sensor."""
    seen = GROUND[100 + down : 550 + down, 100 + across : 700 + across].astype(float)
    return np.clip(seen + noise * np.random.default_rng(across).standard_normal(seen.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("shift", "copy"), [(0, True), (3, True), (6, True), (60, False), (120, False), (300, False)])
def test_a_shift_that_shows_no_depth_is_a_copy(shift: int, copy: bool) -> None:
    copies = NearCopies()
    copies.add(0, view(0))
    copies.add(1, view(shift))
    assert copies(0, 1) == copies(1, 0) == copy


def test_flat_and_unknown_pictures_are_no_copies() -> None:
    copies = NearCopies()
    copies.add(0, np.full((300, 400, 3), 7, np.uint8))
    copies.add(1, np.full((300, 400, 3), 7, np.uint8))
    copies.add(2, view(0)[:, :300])
    assert not copies(0, 1) and not copies(0, 2) and not copies(0, 9)


def test_only_one_of_a_burst_joins_the_seed() -> None:
    """Ten photographs of a hovering drone are most alike; a seed of them alone would have no depth."""
    places = np.array([0.0] * 10 + [0.5 * k for k in range(1, 9)])

    def similarities(first: Sequence[int], second: Sequence[int]) -> np.ndarray:
        return np.exp(-0.5 * (places[list(first)][:, None] - places[list(second)][None]) ** 2)

    def is_copy(a: int, b: int) -> bool:
        return abs(places[a] - places[b]) < 0.1

    chosen = choose_seed(range(18), similarities, 6, frozenset(), is_copy)
    assert len(chosen) == 6 and sum(index < 10 for index in chosen) == 1
    assert sum(index < 10 for index in choose_seed(range(18), similarities, 6, frozenset())) == 6
    assert len(choose_seed(range(10), similarities, 6, frozenset(), is_copy)) == 1
