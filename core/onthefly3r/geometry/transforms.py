"""Rigid and similarity transforms; a variable `b_from_a` maps coordinates of frame a to frame b."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .arrays import Float


def skew(vector: Float) -> Float:
    """Return the (3, 3) matrix K with K @ v = vector x v."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(rotation_vector: Float) -> Float:
    """Return the (3, 3) rotation of an axis-angle vector in radians (Rodrigues)."""
    angle = float(np.linalg.norm(rotation_vector))
    k = skew(np.asarray(rotation_vector, float))
    if angle < 1e-8:
        return np.asarray(np.eye(3) + k + 0.5 * k @ k)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * k + (1.0 - np.cos(angle)) / angle**2 * k @ k)


def rotation_log(rotation: Float) -> Float:
    """Return the axis-angle vector (3,) in radians of a rotation matrix, angle in [0, pi]."""
    vee = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sin, cos = 0.5 * float(np.linalg.norm(vee)), 0.5 * (float(np.trace(rotation)) - 1.0)
    angle = float(np.arctan2(sin, cos))
    if sin > 1e-7:
        return 0.5 * vee * angle / sin
    if cos > 0.0:
        return 0.5 * vee
    # Half a turn: the axis is the eigenvector of R + I that has the largest entry.
    column = int(np.argmax(np.diag(rotation)))
    axis = rotation[:, column] + np.eye(3)[column]
    axis = axis / np.linalg.norm(axis)
    return np.asarray(axis * angle * (1.0 if float(vee @ axis) >= 0.0 else -1.0))


def rotation_angle_deg(rotation: Float) -> float:
    """Return the angle of a rotation in degrees (paper, pose validation residual e_r^R)."""
    return float(np.degrees(np.linalg.norm(rotation_log(rotation))))


def nearest_rotation(matrix: Float) -> Float:
    """Return the rotation closest to a (3, 3) matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def rotate(matrix: Float, points: Float) -> Float:
    """Return matrix @ p for points (..., 3); not by BLAS, whose threads cost more than they save on rows of three."""
    return np.asarray(np.einsum("ij,...j->...i", matrix, points))


@dataclass(frozen=True)
class Rigid3:
    """SE(3): target_from_source(p) = rotation @ p + translation."""

    rotation: Float = field(default_factory=lambda: np.eye(3))  # (3, 3)
    translation: Float = field(default_factory=lambda: np.zeros(3))  # (3,), units of the target frame

    def apply(self, points: Float) -> Float:
        """Map points (..., 3)."""
        return rotate(self.rotation, points) + self.translation

    def inverse(self) -> Rigid3:
        """Return source_from_target."""
        return Rigid3(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """Compose: (c_from_b @ b_from_a) = c_from_a."""
        return Rigid3(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def matrix(self) -> Float:
        """Return the homogeneous (4, 4) matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.translation
        return m


@dataclass(frozen=True)
class Sim3:
    """Sim(3): target_from_source(p) = scale * rotation @ p + translation."""

    scale: float = 1.0
    rotation: Float = field(default_factory=lambda: np.eye(3))  # (3, 3)
    translation: Float = field(default_factory=lambda: np.zeros(3))  # (3,), units of the target frame

    def apply(self, points: Float) -> Float:
        """Map points (..., 3)."""
        return rotate(self.scale * self.rotation, points) + self.translation

    def apply_to_pose(self, source_from_cam: Rigid3) -> Rigid3:
        """Map a camera pose; the camera frame keeps unit scale, only its centre is scaled."""
        return Rigid3(self.rotation @ source_from_cam.rotation, self.apply(source_from_cam.translation))

    def inverse(self) -> Sim3:
        """Return source_from_target."""
        inv_scale = 1.0 / self.scale
        return Sim3(inv_scale, self.rotation.T, -inv_scale * (self.rotation.T @ self.translation))

    def __matmul__(self, other: Sim3) -> Sim3:
        """Compose: (c_from_b @ b_from_a) = c_from_a."""
        return Sim3(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.scale * (self.rotation @ other.translation) + self.translation,
        )

    def matrix(self) -> Float:
        """Return the homogeneous (4, 4) matrix [s R, t; 0, 1]."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.scale * self.rotation, self.translation
        return m
