from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.geometry.transforms import Sim3, rotation_angle_deg, rotation_exp
from onthefly3r.geometry.umeyama import weighted_similarity

seeds = st.integers(0, 2**32 - 1)


def random_sim3(rng: np.random.Generator) -> Sim3:
    return Sim3(float(np.exp(rng.uniform(-3, 3))), rotation_exp(rng.uniform(-1.8, 1.8, 3)), rng.normal(0, 1e3, 3))


@given(seed=seeds, n=st.integers(3, 40))
def test_recovers_a_similarity_exactly(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    truth, source = random_sim3(rng), rng.normal(size=(n, 3))
    found = weighted_similarity(source, truth.apply(source), rng.uniform(0.1, 5.0, n))
    assert found.scale == pytest.approx(truth.scale, rel=1e-6)
    assert rotation_angle_deg(found.rotation.T @ truth.rotation) < 1e-3
    assert np.allclose(found.apply(source), truth.apply(source), atol=1e-6 * max(truth.scale, 1.0))


@given(seed=seeds)
def test_no_nearby_transform_fits_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target, weight = rng.normal(size=(12, 3)), rng.normal(size=(12, 3)), rng.uniform(0.0, 2.0, 12)

    def cost(t: Sim3) -> float:
        return float(weight @ ((t.apply(source) - target) ** 2).sum(axis=1))

    best = weighted_similarity(source, target, weight)
    assert np.linalg.det(best.rotation) == pytest.approx(1.0)
    for _ in range(20):
        step = Sim3(float(np.exp(rng.normal(0, 1e-3))), rotation_exp(rng.normal(0, 1e-3, 3)), rng.normal(0, 1e-3, 3))
        assert cost(best) <= cost(step @ best) + 1e-9


def test_mirrored_points_still_give_a_rotation() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(20, 3))
    found = weighted_similarity(source, source * (1.0, 1.0, -1.0), np.ones(20))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_a_weight_of_zero_removes_a_point() -> None:
    rng = np.random.default_rng(2)
    truth, source = random_sim3(rng), rng.normal(size=(8, 3))
    target, weight = truth.apply(source), np.ones(8)
    target[3] += 500.0
    weight[3] = 0.0
    assert weighted_similarity(source, target, weight).scale == pytest.approx(truth.scale, rel=1e-9)


def test_rigid_fit_keeps_scale_one() -> None:
    rng = np.random.default_rng(3)
    source = rng.normal(size=(10, 3))
    assert weighted_similarity(source, 2.0 * source, np.ones(10), with_scale=False).scale == 1.0


@pytest.mark.parametrize(
    ("source", "weight"),
    [
        (np.eye(3)[:2], np.ones(2)),
        (np.eye(3), np.array([1.0, 1.0, 0.0])),
        (np.ones((5, 3)), np.ones(5)),
        (np.outer(np.arange(6.0), [1.0, 2.0, 3.0]) + 7.0, np.ones(6)),
        (np.eye(3), np.array([1.0, 1.0, -1.0])),
        (np.array([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]), np.ones(3)),
    ],
    ids=["two points", "two weights", "one place", "one line", "negative weight", "not finite"],
)
def test_degenerate_input_is_refused(source: np.ndarray, weight: np.ndarray) -> None:
    with pytest.raises(ValueError):
        weighted_similarity(source, source, weight)


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match="N, 3"):
        weighted_similarity(np.zeros((4, 3)), np.zeros((5, 3)), np.ones(4))
