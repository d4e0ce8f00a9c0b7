from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from onthefly3r.geometry.transforms import Sim3, rotation_angle_deg, rotation_exp, rotation_log
from onthefly3r.records import Alignment, Correspondences, Rejection
from onthefly3r.registration.align import INDEPENDENT_POINTS_PER_REFERENCE, align

TRUE = Sim3(37.0, rotation_exp(np.array([1.2, -0.4, 0.8])), np.array([500.0, -80.0, 12.0]))


def pairs_of(
    n: int = 600, sigma: float = 0.2, outliers: float = 0.0, seed: int = 0, references: int = 3, true: Sim3 = TRUE
) -> Correspondences:
    """Points of a slab 6 x 4 x 0.4 local units, far from the local origin; `sigma` per axis in map units."""
    rng = np.random.default_rng(seed)
    local = rng.uniform(-0.5, 0.5, (n, 3)) * (6.0, 4.0, 0.4) + (2.0, -3.0, 7.0)
    mapped = true.apply(local) + sigma * rng.standard_normal((n, 3))
    wrong = rng.permutation(n)[: round(outliers * n)]
    mapped[wrong] += rng.uniform(-60.0, 60.0, (len(wrong), 3))
    return Correspondences(local, mapped, rng.uniform(0.5, 1.0, n), np.arange(n) % references)


def aligned(pairs: Correspondences) -> Alignment:
    found = align(pairs)
    assert isinstance(found, Alignment), found
    return found


def perturbation(estimate: Sim3, true: Sim3) -> np.ndarray:
    """[w, u, lambda] of the small change after which `true` is `estimate`: true @ change = estimate."""
    change = true.inverse() @ estimate
    return np.concatenate([rotation_log(change.rotation), change.translation, [np.log(change.scale)]])


def test_without_noise_the_similarity_is_exact() -> None:
    found = aligned(pairs_of(sigma=0.0))
    np.testing.assert_allclose(found.map_from_local.matrix(), TRUE.matrix(), rtol=1e-9, atol=1e-8)
    assert found.residual < 1e-9
    assert found.inlier_ratio > 0.9


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_30_percent_outliers(seed: int) -> None:
    """600 points of 0.2 m noise, 30 % of them up to 60 m off: centimetres in place, hundredths of degrees, 0.1 %."""
    pairs = pairs_of(outliers=0.3, seed=seed)
    found = aligned(pairs)
    error = TRUE.inverse() @ found.map_from_local
    assert rotation_angle_deg(error.rotation) < 0.06
    assert abs(np.log(found.map_from_local.scale / TRUE.scale)) < 1e-3
    shift = found.map_from_local.apply(pairs.local) - TRUE.apply(pairs.local)
    assert np.linalg.norm(shift, axis=1).max() < 0.15
    assert 0.6 < found.inlier_ratio < 0.75
    assert 0.2 < found.residual < 0.35  # the median of a sample with 30 % outliers lies higher


def test_huber_is_what_holds_outliers_off() -> None:
    from onthefly3r.geometry.umeyama import weighted_similarity

    pairs = pairs_of(outliers=0.3)
    plain = weighted_similarity(pairs.local, pairs.map, pairs.weight)

    def off(found: Sim3) -> float:
        return float(np.linalg.norm(found.apply(pairs.local) - TRUE.apply(pairs.local), axis=1).mean())

    assert off(aligned(pairs).map_from_local) < 0.2 * off(plain)


@settings(max_examples=20, deadline=None)
@given(map_unit=st.floats(1e-3, 1e3), local_unit=st.floats(1e-3, 1e3))
def test_units_do_not_matter(map_unit: float, local_unit: float) -> None:
    """The same data in other units give the same transform, inliers and covariance in those units."""
    pairs = pairs_of(n=120, outliers=0.2)
    other = replace(pairs, map=pairs.map * map_unit, local=pairs.local * local_unit)
    first, second = aligned(pairs), aligned(other)
    expected = first.map_from_local.scale * map_unit / local_unit
    assert second.map_from_local.scale == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(second.map_from_local.rotation, first.map_from_local.rotation, atol=1e-7)
    assert second.inlier_ratio == first.inlier_ratio
    assert second.residual == pytest.approx(first.residual * map_unit, rel=1e-5)
    units = np.array([1.0, 1.0, 1.0, local_unit, local_unit, local_unit, 1.0])
    size = np.sqrt(np.diag(first.covariance)) * units
    np.testing.assert_allclose(
        second.covariance / np.outer(size, size),
        first.covariance * np.outer(units, units) / np.outer(size, size),
        atol=1e-4,
    )


def test_covariance_agrees_with_monte_carlo() -> None:
    """Independent points: scatter of 300 fits against the stated covariance of seven parameters, within 25 %.

    A reference counts for `INDEPENDENT_POINTS_PER_REFERENCE` points; with no more points than that per reference
    nothing is deflated. Weights are equal, as the covariance takes them to be.
    """
    references = 5
    n = INDEPENDENT_POINTS_PER_REFERENCE * references
    scatter, stated = [], []
    for seed in range(300):
        pairs = pairs_of(n=n, seed=seed, references=references)
        pairs = replace(pairs, local=pairs_of(n=n).local, weight=np.ones(n))
        noise = np.random.default_rng((5, seed)).standard_normal((n, 3))
        found = aligned(replace(pairs, map=TRUE.apply(pairs.local) + 0.2 * noise))
        scatter.append(perturbation(found.map_from_local, TRUE))
        stated.append(found.covariance)
    measured, expected = np.cov(np.array(scatter).T), np.mean(stated, axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(measured)), np.sqrt(np.diag(expected)), rtol=0.25)
    # In every direction: eigenvalues of the measured covariance in units of the stated one.
    whitening = np.linalg.inv(np.linalg.cholesky(expected))
    ratios = np.linalg.eigvalsh(whitening @ measured @ whitening.T)
    assert ratios.min() > 0.5 and ratios.max() < 1.8


def test_many_points_of_one_image_do_not_pretend_to_be_independent() -> None:
    few, many = (aligned(pairs_of(n=n, references=2)).covariance for n in (24, 2400))
    assert 0.5 < np.sqrt(np.trace(many) / np.trace(few)) < 2.0


def test_more_references_tell_more() -> None:
    one, four = (aligned(pairs_of(n=2400, references=count)).covariance for count in (1, 4))
    np.testing.assert_allclose(np.sqrt(np.diag(one) / np.diag(four)), 2.0, rtol=1e-6)


def test_too_few_points_are_a_rejection_with_numbers() -> None:
    found = align(pairs_of(n=11), images=(4, 7))
    assert isinstance(found, Rejection)
    assert (found.images, found.stage, found.numbers) == ((4, 7), "alignment", {"points": 11.0})


def test_points_on_a_line_are_a_rejection() -> None:
    pairs = pairs_of(n=50, sigma=0.0)
    line = pairs.local[:, :1] * (1.0, 2.0, 3.0)
    found = align(replace(pairs, local=line, map=TRUE.apply(line)))
    assert isinstance(found, Rejection)
    assert "line" in found.reason


def test_references_are_named() -> None:
    assert aligned(pairs_of(references=4)).references == (0, 1, 2, 3)
