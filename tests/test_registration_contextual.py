from __future__ import annotations

from dataclasses import replace

import numpy as np

from onthefly3r.records import LocalView, Subset
from onthefly3r.registration.contextual import incompatible_references
from synthetic_models import true_view

SUBSET = Subset((0, 1, 2, 3, 4), (10, 11))


def views_with(turned: dict[int, float], noise: float = 0.05) -> dict[int, LocalView]:
    """Tokens near one direction; `turned` ones have this share of a direction of their own."""
    rng = np.random.default_rng(0)
    common, view = rng.standard_normal(64), true_view(0)
    views = {}
    for index in SUBSET.members:
        stray = rng.standard_normal(64)
        share = turned.get(index, noise)
        views[index] = replace(view, tokens=3.0 * (common + share * stray))
    return views


def test_the_reference_whose_token_stands_out_is_dropped() -> None:
    assert incompatible_references(SUBSET, views_with({3: 1.5}), 3) == (3,)


def test_two_are_dropped_worst_first() -> None:
    assert incompatible_references(SUBSET, views_with({1: 1.0, 3: 3.0}), 3) == (3, 1)


def test_the_minimum_stays() -> None:
    assert incompatible_references(SUBSET, views_with({1: 1.0, 3: 3.0}), 4) == (3,)
    assert incompatible_references(SUBSET, views_with({3: 3.0}), 5) == ()


def test_nothing_is_dropped_without_tokens_or_without_new_images() -> None:
    views = {i: replace(v, tokens=None) for i, v in views_with({3: 3.0}).items()}
    assert incompatible_references(SUBSET, views, 3) == ()
    assert incompatible_references(replace(SUBSET, new=()), views_with({3: 3.0}), 3) == ()


def test_the_length_of_a_token_does_not_matter() -> None:
    views = views_with({3: 1.5})
    longer = {i: replace(v, tokens=v.tokens * (i + 1)) for i, v in views.items() if v.tokens is not None}
    assert incompatible_references(SUBSET, longer, 3) == (3,)


def test_the_new_images_outvote_a_majority_of_bad_references() -> None:
    views = views_with({0: 1.5, 2: 2.0, 3: 3.0})
    assert set(incompatible_references(SUBSET, views, 2)) == {0, 2, 3}
    assert len(incompatible_references(SUBSET, views, 3)) == 2
    assert set(incompatible_references(replace(SUBSET, new=(10,)), views, 2)) == {0, 2, 3}


def test_one_bad_new_image_of_three_does_not_cost_a_good_reference() -> None:
    subset = Subset((0, 1, 2, 3), (4, 10, 11))
    assert incompatible_references(subset, views_with({10: 2.0}), 3) == ()
    assert incompatible_references(subset, views_with({10: 2.0, 2: 2.0}), 3) == (2,)


def test_references_like_the_new_images_all_stay() -> None:
    assert incompatible_references(SUBSET, views_with({}), 1) == ()
