from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from onthefly3r.geometry.transforms import Rigid3, Sim3
from onthefly3r.options import RegistrationOptions
from onthefly3r.records import Alignment, Rejection
from onthefly3r.registration.geometric import only, prune_references
from onthefly3r.registration.references import correspond
from onthefly3r.registration.validate import ReferenceVerdict, validate_references
from synthetic_models import MAP_FROM_LOCAL, local_model, misplaced, true_references, world_from_cam

REFERENCES = (0, 1, 2, 5, 6)
POSES = {i: world_from_cam(i) for i in range(15)}
SPACING_M = 2.1


def prune(
    bad: Mapping[int, Rigid3],
    references: tuple[int, ...] = REFERENCES,
    min_references: int = 3,
    seen: list[tuple[int, ...]] | None = None,
) -> tuple[Alignment, ReferenceVerdict] | Rejection:
    """Register references of 0.1 m noise; `seen` collects which groups were tried, in order."""
    model = local_model(references, bad=bad)
    pairs = correspond(model, true_references(references), {i: Sim3() for i in references}, 0.5)

    def validate(alignment: Alignment) -> ReferenceVerdict:
        if seen is not None:
            seen.append(alignment.references)
        return validate_references(model, alignment, POSES, SPACING_M, RegistrationOptions())

    return prune_references(model, pairs, POSES, min_references, validate)


def kept_by(outcome: tuple[Alignment, ReferenceVerdict] | Rejection) -> tuple[int, ...]:
    assert not isinstance(outcome, Rejection), outcome
    assert outcome[1].passed
    off = outcome[0].map_from_local.apply(np.zeros((1, 3))) - MAP_FROM_LOCAL.translation
    assert np.linalg.norm(off) < 1.0
    return outcome[0].references


def test_good_references_all_stay() -> None:
    seen: list[tuple[int, ...]] = []
    assert kept_by(prune({}, seen=seen)) == REFERENCES
    assert len(seen) == 1


@pytest.mark.parametrize("index", REFERENCES)
@pytest.mark.parametrize("seed", range(2))
def test_one_bad_of_five_is_dropped(index: int, seed: int) -> None:
    kept = kept_by(prune({index: misplaced(index, 30.0, 40.0, seed)}))
    assert kept == tuple(r for r in REFERENCES if r != index)


@pytest.mark.parametrize("first,second", [(0, 6), (1, 2), (5, 6)])
@pytest.mark.parametrize("seed", range(2))
def test_two_bad_of_five_are_dropped(first: int, second: int, seed: int) -> None:
    bad = {i: misplaced(i, 30.0, 40.0, seed) for i in (first, second)}
    assert kept_by(prune(bad)) == tuple(r for r in REFERENCES if r not in bad)


@pytest.mark.parametrize("turn_deg,shift_m", [(0.0, 25.0), (12.0, 0.0), (5.0, 20.0)])
def test_a_moderately_bad_one_is_dropped_too(turn_deg: float, shift_m: float) -> None:
    """Less than the absolute shift gate of 105 m: the others' agreement gives it away."""
    assert 2 not in kept_by(prune({2: misplaced(2, turn_deg, shift_m)}))


def test_the_worst_goes_first() -> None:
    seen: list[tuple[int, ...]] = []
    kept_by(prune({1: misplaced(1, 10.0, 20.0), 6: misplaced(6, 60.0, 90.0)}, seen=seen))
    assert seen == [REFERENCES, (0, 1, 2, 5), (0, 2, 5)]


def test_never_fewer_than_the_minimum() -> None:
    seen: list[tuple[int, ...]] = []
    bad = {i: misplaced(i, 30.0, 40.0, seed=i) for i in (0, 2, 6)}
    outcome = prune(bad, seen=seen)
    assert isinstance(outcome, Rejection)
    assert min(len(group) for group in seen) == 3
    assert outcome.stage == "references" and outcome.reason
    assert outcome.numbers["references"] == 5.0
    assert outcome.numbers["median_shift"] > 0.0


def test_a_rejection_of_too_few_references_says_so() -> None:
    outcome = prune({}, references=(0, 1))
    assert isinstance(outcome, Rejection)
    assert outcome.reason == "too few references"


def test_only_keeps_the_pairs_of_some_references() -> None:
    pairs = correspond(local_model([0, 1]), true_references([0, 1]), {0: Sim3(), 1: Sim3()}, 0.5)
    kept = only(pairs, (1,))
    assert set(kept.reference) == {1}
    assert len(kept.local) == len(kept.map) == len(kept.weight) == (pairs.reference == 1).sum()
