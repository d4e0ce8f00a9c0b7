from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from onthefly3r.geometry.transforms import (
    Rigid3,
    Sim3,
    nearest_rotation,
    rotation_angle_deg,
    rotation_exp,
    rotation_log,
    skew,
)

# Angles of all sizes, with the two places where formulas degenerate: next to zero and next to half a turn.
angles = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(0.0, 1e-6),
    st.floats(1e-12, 1e-7),
    st.floats(0.0, 1e-6).map(lambda a: np.pi - a),
    st.just(np.pi),
)
axes = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda a: np.linalg.norm(a) > 1e-3)
seeds = st.integers(0, 2**32 - 1)


def vector(axis: np.ndarray, angle: float) -> np.ndarray:
    return axis / np.linalg.norm(axis) * angle


def random_sim3(rng: np.random.Generator) -> Sim3:
    return Sim3(float(np.exp(rng.normal())), rotation_exp(rng.uniform(-2, 2, 3)), rng.normal(0, 50, 3))


@given(axis=axes, angle=angles)
def test_exp_agrees_with_scipy(axis: np.ndarray, angle: float) -> None:
    w = vector(axis, angle)
    assert np.allclose(rotation_exp(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-12)


@given(axis=axes, angle=angles)
def test_log_is_the_inverse_of_exp(axis: np.ndarray, angle: float) -> None:
    """Compared as rotations near half a turn, where the axis may flip its sign."""
    w = vector(axis, angle)
    back = rotation_log(rotation_exp(w))
    assert np.allclose(rotation_exp(back), rotation_exp(w), atol=1e-7)
    assert np.linalg.norm(back) == pytest.approx(angle, abs=1e-7)
    if angle < 3.0:
        assert np.allclose(back, w, atol=1e-9)


@given(axis=axes, angle=angles)
def test_angle(axis: np.ndarray, angle: float) -> None:
    assert rotation_angle_deg(rotation_exp(vector(axis, angle))) == pytest.approx(np.degrees(angle), abs=1e-5)


def test_half_turns_about_the_axes() -> None:
    for axis in np.eye(3):
        half = 2.0 * np.outer(axis, axis) - np.eye(3)
        assert np.abs(rotation_log(half)) == pytest.approx(np.pi * axis)


@given(seed=seeds)
def test_nearest_rotation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = rotation_exp(rng.normal(size=3))
    assert np.allclose(nearest_rotation(3.0 * rotation), rotation, atol=1e-12)
    matrix = rng.normal(size=(3, 3))
    nearest = nearest_rotation(matrix)
    assert np.linalg.det(nearest) == pytest.approx(1.0)
    for _ in range(5):
        other = nearest @ rotation_exp(rng.normal(0, 0.05, 3))
        assert np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - other) + 1e-12


@given(seed=seeds)
def test_skew_is_the_cross_product(seed: int) -> None:
    a, b = np.random.default_rng(seed).normal(size=(2, 3))
    assert np.allclose(skew(a) @ b, np.cross(a, b))


@given(seed=seeds)
def test_similarity_group(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (random_sim3(rng) for _ in range(3))
    points = rng.normal(size=(4, 3))
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-8)
    assert np.allclose(((a @ b) @ c).apply(points), (a @ (b @ c)).apply(points), atol=1e-7)
    assert np.allclose((a @ a.inverse()).matrix(), np.eye(4), atol=1e-9)
    assert np.allclose((a.inverse() @ a).matrix(), np.eye(4), atol=1e-9)
    homogeneous = np.c_[points, np.ones(4)] @ a.matrix().T
    assert np.allclose(homogeneous[:, :3], a.apply(points))
    assert np.allclose(Sim3().apply(points), points)


@given(seed=seeds)
def test_rigid_group(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (Rigid3(rotation_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
    points = rng.normal(size=(2, 4, 3))
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)))
    assert np.allclose((a @ a.inverse()).matrix(), np.eye(4), atol=1e-12)
    assert np.allclose((a @ b).matrix(), a.matrix() @ b.matrix())


@given(seed=seeds)
def test_a_similarity_moves_cameras_with_their_points(seed: int) -> None:
    """What a camera sees keeps its direction; its depth scales."""
    rng = np.random.default_rng(seed)
    target_from_source = random_sim3(rng)
    source_from_cam = Rigid3(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    point = rng.normal(size=3)
    seen = source_from_cam.inverse().apply(point)
    moved = target_from_source.apply_to_pose(source_from_cam).inverse().apply(target_from_source.apply(point))
    assert np.allclose(moved, target_from_source.scale * seen, atol=1e-9)
