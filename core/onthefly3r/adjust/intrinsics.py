"""The intrinsics that self-calibration estimates, and how a pixel depends on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..geometry.arrays import Float
from ..geometry.camera import Camera

# aspect = fx / fy; the principal point as fractions of width and height.
PARAMETERS = ("log_focal", "log_aspect", "k1", "k2", "p1", "p2", "centre_x", "centre_y")
WITHOUT_PRINCIPAL_POINT = np.array([not name.startswith("centre") for name in PARAMETERS])


def intrinsics_of(camera: Camera) -> Float:
    """Return `PARAMETERS` (8,) of a camera."""
    focal, aspect = 0.5 * np.log(camera.fx * camera.fy), np.log(camera.fx / camera.fy)
    return np.array([focal, aspect, *camera.distortion, camera.cx / camera.width, camera.cy / camera.height])


def with_intrinsics(camera: Camera, parameters: Float) -> Camera:
    """Return the camera with other `PARAMETERS` (8,)."""
    focal, aspect = np.exp(parameters[0]), np.exp(0.5 * parameters[1])
    k1, k2, p1, p2, x, y = (float(p) for p in parameters[2:])
    return replace(
        camera,
        fx=float(focal * aspect),
        fy=float(focal / aspect),
        cx=x * camera.width,
        cy=y * camera.height,
        distortion=(k1, k2, p1, p2),
    )


def projection_jacobians(camera: Camera, seen: Float) -> tuple[Float, Float]:
    """Return d pixel / d point (M, 2, 3) and d pixel / d PARAMETERS (M, 2, 8) of points (M, 3) in the camera frame."""
    k1, k2, p1, p2 = camera.distortion
    x, y, z = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2], seen[:, 2]
    r2 = x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y  # d xd / d y = d yd / d x
    yy = radial + slope * y * y + 2.0 * p2 * x + 6.0 * p1 * y
    u_by_seen = camera.fx * np.stack([xx, xy, -(x * xx + y * xy)], axis=1)
    v_by_seen = camera.fy * np.stack([xy, yy, -(x * xy + y * yy)], axis=1)
    none, one = np.zeros_like(x), np.ones_like(x)
    by_x, by_y = camera.width / camera.fx * one, camera.height / camera.fy * one
    u = np.stack([xd, 0.5 * xd, x * r2, x * r2**2, 2.0 * x * y, r2 + 2.0 * x * x, by_x, none], axis=1)
    v = np.stack([yd, -0.5 * yd, y * r2, y * r2**2, r2 + 2.0 * y * y, 2.0 * x * y, none, by_y], axis=1)
    return (
        np.stack([u_by_seen, v_by_seen], axis=1) / z[:, None, None],
        np.stack([camera.fx * u, camera.fy * v], axis=1),
    )
