from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from onthefly3r.geometry.frames import enu_from_cam_rotation, gimbal_angles_deg, omega_phi_kappa_deg

yaws = st.floats(-179.0, 179.0)
rolls = st.floats(-60.0, 60.0)


@given(yaw=yaws, pitch=st.floats(-180.0, 180.0), roll=rolls)
def test_is_a_rotation(yaw: float, pitch: float, roll: float) -> None:
    r = enu_from_cam_rotation(yaw, pitch, roll)
    assert np.allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(r) == pytest.approx(1.0)


def test_known_attitudes() -> None:
    """Columns are the camera's right, down and forward in east, north, up."""
    level_north = enu_from_cam_rotation(0.0, 0.0, 0.0)
    assert np.allclose(level_north.T, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    level_east = enu_from_cam_rotation(90.0, 0.0, 0.0)
    assert np.allclose(level_east[:, 2], [1, 0, 0], atol=1e-12)
    nadir_north = enu_from_cam_rotation(0.0, -90.0, 0.0)
    assert np.allclose(nadir_north.T, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)
    nadir_30 = enu_from_cam_rotation(30.0, -90.0, 0.0)  # image top points 30 degrees east of north
    assert np.allclose(-nadir_30[:, 1], [0.5, np.sqrt(0.75), 0.0])
    oblique = enu_from_cam_rotation(0.0, -60.0, 0.0)
    assert np.allclose(oblique[:, 2], [0.0, 0.5, -np.sqrt(0.75)])
    banked = enu_from_cam_rotation(0.0, 0.0, 10.0)  # positive roll lowers the right edge
    assert banked[2, 0] == pytest.approx(-np.sin(np.radians(10.0)))


@given(yaw=yaws, pitch=st.floats(-89.0, 89.0), roll=rolls)
def test_angles_come_back(yaw: float, pitch: float, roll: float) -> None:
    assert gimbal_angles_deg(enu_from_cam_rotation(yaw, pitch, roll)) == pytest.approx((yaw, pitch, roll), abs=1e-6)


@given(yaw=yaws, roll=rolls, near=st.sampled_from([0.0, 1e-9, 1e-7, 1e-5, 1e-3]))
def test_near_nadir_the_rotation_comes_back(yaw: float, roll: float, near: float) -> None:
    """Yaw and roll are one angle there; what counts is the rotation."""
    r = enu_from_cam_rotation(yaw, -90.0 + near, roll)
    assert np.allclose(enu_from_cam_rotation(*gimbal_angles_deg(r)), r, atol=1e-4)


@given(omega=st.floats(-80, 80), phi=st.floats(-80, 80), kappa=st.floats(-179, 179))
def test_omega_phi_kappa_by_scipy(omega: float, phi: float, kappa: float) -> None:
    """R = Rx(omega) Ry(phi) Rz(kappa) of the photogrammetric camera (x right, y up, z backward)."""
    photogrammetric = Rotation.from_euler("XYZ", [omega, phi, kappa], degrees=True).as_matrix()
    found = omega_phi_kappa_deg(photogrammetric @ np.diag([1.0, -1.0, -1.0]))
    assert found == pytest.approx((omega, phi, kappa), abs=1e-9)


def test_nadir_gimbal_yaw_is_minus_kappa() -> None:
    assert omega_phi_kappa_deg(enu_from_cam_rotation(0.0, -90.0, 0.0)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert omega_phi_kappa_deg(enu_from_cam_rotation(30.0, -90.0, 0.0)) == pytest.approx((0.0, 0.0, -30.0), abs=1e-9)
