"""Photographs as their files store them, against the upright ones that everything else is about (EXIF orientation)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .arrays import Float
from .camera import Camera
from .transforms import Rigid3

# Orientation -> the matrix that takes offsets in the upright image to offsets in the stored one.
_STORED_FROM_UPRIGHT = {
    1: ((1, 0), (0, 1)),
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, 1), (-1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, -1), (1, 0)),
}


def stored_from_upright(orientation: int) -> Float:
    """Return the matrix (2, 2) that takes offsets in the upright image to offsets in the stored one."""
    return np.array(_STORED_FROM_UPRIGHT.get(orientation, _STORED_FROM_UPRIGHT[1]), float)


def stored_pixels(upright: Float, width: float, height: float, orientation: int) -> Float:
    """Map pixels (..., 2) of an upright photograph of this size to those of its file."""
    turn = stored_from_upright(orientation)
    size = np.array([width, height], float)
    return np.asarray((np.asarray(upright) - size / 2) @ turn.T + np.abs(turn) @ size / 2)


def upright_pixels(stored: Float, width: float, height: float, orientation: int) -> Float:
    """Map pixels (..., 2) of a file to those of its upright photograph, which has this size."""
    turn = stored_from_upright(orientation)
    size = np.array([width, height], float)
    return np.asarray((np.asarray(stored) - np.abs(turn) @ size / 2) @ turn + size / 2)


def is_turn(orientation: int) -> bool:
    """Return whether the stored image is a turned one; a mirrored one is no image of any camera."""
    return bool(np.linalg.det(stored_from_upright(orientation)) > 0.0)


def stored_camera(upright: Camera, orientation: int) -> Camera:
    """Return the camera of the file as stored; tangential distortion (p2, p1) turns as a vector."""
    turn = stored_from_upright(orientation)
    width, height = (int(v) for v in np.abs(turn) @ (upright.width, upright.height))
    fx, fy = np.abs(turn) @ (upright.fx, upright.fy)
    cx, cy = stored_pixels(np.array([upright.cx, upright.cy]), upright.width, upright.height, orientation)
    k1, k2, p1, p2 = upright.distortion
    p2, p1 = (float(v) + 0.0 for v in turn @ (p2, p1))
    return replace(
        upright,
        width=width,
        height=height,
        fx=float(fx),
        fy=float(fy),
        cx=float(cx),
        cy=float(cy),
        distortion=(k1, k2, p1, p2),
    )


def stored_pose(world_from_cam: Rigid3, orientation: int) -> Rigid3:
    """Return the pose of the camera of the file as stored; its axes are turned about the view."""
    cam_from_stored = np.eye(3)
    cam_from_stored[:2, :2] = stored_from_upright(orientation).T
    return Rigid3(world_from_cam.rotation @ cam_from_stored, world_from_cam.translation)
