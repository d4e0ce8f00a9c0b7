"""Coverage and weak areas against areas that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.products.coverage import covered, weak_areas
from onthefly3r.products.footprints import Footprint

ORIGIN = np.array([400_000.0, 5_500_000.0])


def square(x: float, y: float, side: float = 100.0) -> Footprint:
    corners = np.array([[0.0, 0.0], [0.0, side], [side, side], [side, 0.0]]) + np.array([x, y])
    return Footprint(f"{x} {y}.jpg", 1, corners + ORIGIN, 0.05)


def test_nothing_covers_nothing() -> None:
    assert covered([]).is_empty
    assert weak_areas([]) == []


def test_union_counts_common_ground_once() -> None:
    assert covered([square(0, 0), square(50, 0)]).area == pytest.approx(15_000.0)


def test_three_photographs_are_enough() -> None:
    assert weak_areas([square(0, 0)] * 3) == []


def test_areas_that_too_few_show_are_found_with_their_counts() -> None:
    found = weak_areas([square(0, 0), square(0, 0), square(0, 0), square(80, 0), square(80, 0)])
    assert [weak.photographs for weak in found] == [2]
    assert found[0].area.area == pytest.approx(80.0 * 100.0, rel=0.01)
    low, high = ORIGIN + np.array([100.0, 0.0]), ORIGIN + np.array([180.0, 100.0])
    assert found[0].area.bounds == pytest.approx((*low, *high), abs=0.3)
    assert "rim" in found[0].reason


def test_a_gap_inside_the_survey_is_told() -> None:
    ring = [square(x, y) for x in (0, 90, 180) for y in (0, 90, 180) if (x, y) != (90, 90)]
    found = weak_areas([footprint for footprint in ring for _ in range(3)])
    assert [weak.photographs for weak in found] == [0]
    assert found[0].area.area == pytest.approx(80.0**2, rel=0.02)
    assert found[0].reason == "no photograph shows it, inside the survey: fly here again"
