"""Many similarities at once against single ones, and against matrix exponentials and differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, logm

from onthefly3r.geometry.similarities import Similarities, log_derivative
from onthefly3r.geometry.transforms import Rigid3, Sim3, skew

# Rotation in rad, translation, logarithm of scale: none, tiny, small, and up to all but half a turn.
SIZES = [0.0, 1e-12, 1e-6, 1e-3, 0.3, 0.5, 2.0, 3.1]


def twists(size: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turn = rng.standard_normal((5, 3))
    turn *= size / np.linalg.norm(turn, axis=1)[:, None]
    return np.column_stack([turn, 20.0 * rng.standard_normal((5, 3)), size * rng.uniform(-1.0, 1.0, 5)])


def generator(twist: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = skew(twist[:3]) + twist[6] * np.eye(3)
    matrix[:3, 3] = twist[3:6]
    return matrix


@pytest.mark.parametrize("size", SIZES)
def test_exp_is_the_matrix_exponential_and_log_its_inverse(size: float) -> None:
    many = Similarities.exp(twists(size))
    for row, twist in enumerate(twists(size)):
        np.testing.assert_allclose(many.single(row).matrix(), expm(generator(twist)), rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(Sim3.exp(twist).matrix(), many.single(row).matrix(), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(Sim3.exp(twist).log(), twist, rtol=1e-9, atol=1e-9)
        rigid = Rigid3.exp(twist[:6])
        np.testing.assert_allclose(rigid.matrix(), expm(generator(np.append(twist[:6], 0.0))), rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(rigid.log(), twist[:6], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(many.log(), twists(size), rtol=1e-9, atol=1e-9)


def test_composing_and_inverting_is_that_of_single_ones() -> None:
    first, second = (Similarities.exp(twists(1.0, seed)) for seed in (1, 2))
    together, back = first @ second, first.inverse()
    for row in range(5):
        np.testing.assert_allclose(
            together.single(row).matrix(), (first.single(row) @ second.single(row)).matrix(), atol=1e-12
        )
        np.testing.assert_allclose(back.single(row).matrix(), first.single(row).inverse().matrix(), atol=1e-12)
    stacked = Similarities.of([first.single(row) for row in range(5)])
    np.testing.assert_array_equal(stacked.translation, first.translation)


@pytest.mark.parametrize("size", [0.0, 0.1, 2.0])
def test_the_adjoint_moves_a_twist_through_a_transform(size: float) -> None:
    many, small = Similarities.exp(twists(size)), twists(0.2, 7)
    for row in range(5):
        one = many.single(row)
        np.testing.assert_allclose(many.adjoint()[row], one.adjoint(), atol=1e-12)
        moved = one @ Sim3.exp(small[row]) @ one.inverse()
        np.testing.assert_allclose(Sim3.exp(one.adjoint() @ small[row]).matrix(), moved.matrix(), atol=1e-8)
        rigid = Rigid3(one.rotation, one.translation)
        moved_rigid = rigid @ Rigid3.exp(small[row, :6]) @ rigid.inverse()
        np.testing.assert_allclose(
            Rigid3.exp(rigid.adjoint() @ small[row, :6]).matrix(), moved_rigid.matrix(), atol=1e-8
        )


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.1, 0.2, 0.39, 0.41, 1.0, 2.9])
def test_the_derivative_of_the_logarithm(size: float) -> None:
    """By central differences, on both sides of where the series gives way to the inverse."""
    at, h = twists(size, 3), 1e-6
    found = log_derivative(at)
    for k in range(7):
        step = np.zeros((5, 7))
        step[:, k] = h
        ahead, behind = ((Similarities.exp(at) @ Similarities.exp(sign * step)).log() for sign in (1.0, -1.0))
        np.testing.assert_allclose(found[:, :, k], (ahead - behind) / (2.0 * h), atol=2e-6, rtol=1e-6)


def test_logarithm_agrees_with_scipy() -> None:
    many = Similarities.exp(twists(1.0, 4))
    for row in range(5):
        np.testing.assert_allclose(logm(many.single(row).matrix()).real, generator(many.log()[row]), atol=1e-8)


def test_equal_means_all_numbers_are() -> None:
    one, other = Sim3.exp(twists(1.0)[0]), Sim3.exp(twists(1.0)[0])
    assert one == other and one is not other
    assert one != Sim3(one.scale, one.rotation, one.translation + 1e-15 * np.abs(one.translation).max())
    assert Rigid3(one.rotation, one.translation) == Rigid3(one.rotation.copy(), one.translation.copy())
    assert Rigid3() != Sim3()
    with pytest.raises(TypeError):
        hash(one)
