"""Attitude conventions: DJI gimbal angles, local east-north-up, and omega-phi-kappa.

World axes are east, north, up; camera axes are OpenCV's (x right, y down, z forward).
"""

from __future__ import annotations

import numpy as np

from .arrays import Float

NED_FROM_BODY_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # camera -> body (x forward)
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
PHOTOGRAMMETRIC_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])  # y up, z backward


def _axis_rotation(axis: int, angle_deg: float) -> Float:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    r = np.eye(3)
    r[i, i] = r[j, j] = c
    r[i, j], r[j, i] = -s, s
    return r


def enu_from_cam_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float:
    """Return the (3, 3) rotation ENU <- camera of DJI gimbal angles (yaw from true north, pitch -90 is nadir)."""
    ned_from_body = _axis_rotation(2, yaw_deg) @ _axis_rotation(1, pitch_deg) @ _axis_rotation(0, roll_deg)
    return np.asarray(ENU_FROM_NED @ ned_from_body @ NED_FROM_BODY_AXES)


def gimbal_angles_deg(enu_from_cam: Float) -> tuple[float, float, float]:
    """Return (yaw, pitch, roll) in degrees, the inverse of `enu_from_cam_rotation`; roll is 0 at nadir."""
    r = ENU_FROM_NED.T @ enu_from_cam @ NED_FROM_BODY_AXES.T
    pitch = float(np.degrees(np.arcsin(np.clip(-r[2, 0], -1.0, 1.0))))
    if abs(r[2, 0]) > 1.0 - 1e-9:  # straight down or up: yaw and roll turn about the same axis
        yaw, roll = float(np.degrees(np.arctan2(-r[0, 1], r[1, 1]))), 0.0
    else:
        yaw = float(np.degrees(np.arctan2(r[1, 0], r[0, 0])))
        roll = float(np.degrees(np.arctan2(r[2, 1], r[2, 2])))
    return yaw, pitch, roll


def omega_phi_kappa_deg(world_from_cam: Float) -> tuple[float, float, float]:
    """Return photogrammetric (omega, phi, kappa) in degrees of a rotation world <- OpenCV camera.

    Nadir with the image top to grid north gives (0, 0, 0).
    """
    r = world_from_cam @ PHOTOGRAMMETRIC_FROM_OPENCV
    omega = np.degrees(np.arctan2(-r[1, 2], r[2, 2]))
    phi = np.degrees(np.arcsin(np.clip(r[0, 2], -1.0, 1.0)))
    kappa = np.degrees(np.arctan2(-r[0, 1], r[0, 0]))
    return float(omega), float(phi), float(kappa)


def world_from_cam_rotation(omega_deg: float, phi_deg: float, kappa_deg: float) -> Float:
    """Return the (3, 3) rotation world <- OpenCV camera, the inverse of `omega_phi_kappa_deg`."""
    r = _axis_rotation(0, omega_deg) @ _axis_rotation(1, phi_deg) @ _axis_rotation(2, kappa_deg)
    return np.asarray(r @ PHOTOGRAMMETRIC_FROM_OPENCV.T)
