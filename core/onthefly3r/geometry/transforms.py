"""Rigid and similarity transforms; a variable `b_from_a` maps coordinates of frame a to frame b."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .arrays import Float

# Gauss-Legendre nodes and weights on [0, 1]; twelve integrate what is below to rounding.
_NODES, _WEIGHTS = (part / 2.0 for part in np.polynomial.legendre.leggauss(12))
_NODES = _NODES + 0.5


def skew(vector: Float) -> Float:
    """Return the (..., 3, 3) matrices K with K @ v = vector x v, of vectors (..., 3)."""
    vector = np.asarray(vector, float)
    k = np.zeros((*vector.shape[:-1], 3, 3))
    k[..., 2, 1], k[..., 0, 2], k[..., 1, 0] = vector[..., 0], vector[..., 1], vector[..., 2]
    k[..., 1, 2], k[..., 2, 0], k[..., 0, 1] = -vector[..., 0], -vector[..., 1], -vector[..., 2]
    return k


def rotation_exp(rotation_vector: Float) -> Float:
    """Return the (..., 3, 3) rotations of axis-angle vectors (..., 3) in radians (Rodrigues).

    R = I + sin(a) / a K + (1 - cos(a)) / a^2 K^2 with the angle a and K = skew(rotation_vector).
    """
    k = skew(rotation_vector)
    turns = np.sqrt((np.asarray(rotation_vector, float) ** 2).sum(axis=-1))[..., None, None] / np.pi  # half turns
    return np.asarray(np.eye(3) + np.sinc(turns) * k + 0.5 * np.sinc(0.5 * turns) ** 2 * (k @ k))


def rotation_log(rotation: Float) -> Float:
    """Return the axis-angle vectors (..., 3) in radians of rotation matrices (..., 3, 3), angles in [0, pi]."""
    r = np.asarray(rotation, float)
    pairs = (r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1])
    vee = np.stack(pairs, axis=-1)
    sin = 0.5 * np.sqrt((vee**2).sum(axis=-1))
    cos = 0.5 * (r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1.0)
    angle = np.arctan2(sin, cos)
    result = (0.5 * np.where(sin > 1e-7, angle / np.maximum(sin, 1e-7), 1.0))[..., None] * vee
    half_turn = (sin <= 1e-7) & (cos < 0.0)
    if half_turn.any():
        # The axis is the eigenvector of R + I that has the largest entry.
        turned, about = r[half_turn], vee[half_turn]
        column = np.argmax(np.einsum("...ii->...i", turned), axis=-1)
        axis = np.take_along_axis(turned, column[:, None, None], axis=2)[:, :, 0] + np.eye(3)[column]
        axis = axis / np.linalg.norm(axis, axis=1)[:, None]
        sign = np.where(np.einsum("ni,ni->n", about, axis) >= 0.0, 1.0, -1.0)
        result[half_turn] = (angle[half_turn] * sign)[:, None] * axis
    return np.asarray(result)


def translation_jacobian(rotation_vector: Float, log_scale: Float | float) -> Float:
    """Return V (..., 3, 3), which takes the translation of a twist to that of its exponential.

    V = integral over a in [0, 1] of exp(a l) R(a w) = A I + B K + C K^2 with K = skew(w) (w in rad, l the logarithm of
    scale). A quadrature needs no special cases where w or l vanish: it is exact to rounding up to half a turn and a
    scale of 100.
    """
    k = skew(rotation_vector)
    angle = np.sqrt((np.asarray(rotation_vector, float) ** 2).sum(axis=-1))[..., None]
    turns = _NODES * angle / np.pi
    grown = _WEIGHTS * np.exp(_NODES * np.asarray(log_scale, float)[..., None])
    a = grown.sum(axis=-1)[..., None, None]
    b = (grown * _NODES * np.sinc(turns)).sum(axis=-1)[..., None, None]
    c = (grown * _NODES**2 * 0.5 * np.sinc(0.5 * turns) ** 2).sum(axis=-1)[..., None, None]
    return np.asarray(a * np.eye(3) + b * k + c * (k @ k))


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


@dataclass(frozen=True, eq=False)
class Rigid3:
    """SE(3): target_from_source(p) = rotation @ p + translation.

    Twists are [rotation rad, translation] (6,). Two transforms are equal when all their numbers are.
    """

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

    @classmethod
    def exp(cls, twist: Float) -> Rigid3:
        """Return the transform of a twist (6,): the matrix exponential of [skew(w), u; 0, 0]."""
        w, u = np.split(np.asarray(twist, float), 2)
        return cls(rotation_exp(w), translation_jacobian(w, 0.0) @ u)

    def log(self) -> Float:
        """Return the twist (6,), angle in [0, pi]: the inverse of `exp`."""
        w = rotation_log(self.rotation)
        return np.concatenate([w, np.linalg.solve(translation_jacobian(w, 0.0), self.translation)])

    def adjoint(self) -> Float:
        """Return Ad (6, 6) with T exp(x) T^-1 = exp(Ad x)."""
        result = np.zeros((6, 6))
        result[:3, :3] = result[3:, 3:] = self.rotation
        result[3:, :3] = skew(self.translation) @ self.rotation
        return result

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Rigid3):
            return NotImplemented
        return np.array_equal(self.rotation, other.rotation) and np.array_equal(self.translation, other.translation)

    __hash__ = None  # type: ignore[assignment]  # arrays can change


@dataclass(frozen=True, eq=False)
class Sim3:
    """Sim(3): target_from_source(p) = scale * rotation @ p + translation.

    Twists are [rotation rad, translation, log scale] (7,). Two transforms are equal when all their numbers are.
    """

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

    @classmethod
    def exp(cls, twist: Float) -> Sim3:
        """Return the transform of a twist (7,): the matrix exponential of [skew(w) + l I, u; 0, 0]."""
        w, u, log_scale = np.split(np.asarray(twist, float), [3, 6])
        return cls(float(np.exp(log_scale[0])), rotation_exp(w), translation_jacobian(w, log_scale[0]) @ u)

    def log(self) -> Float:
        """Return the twist (7,), angle in [0, pi]: the inverse of `exp`."""
        w, log_scale = rotation_log(self.rotation), np.log(self.scale)
        return np.array([*w, *np.linalg.solve(translation_jacobian(w, log_scale), self.translation), log_scale])

    def adjoint(self) -> Float:
        """Return Ad (7, 7) with T exp(x) T^-1 = exp(Ad x)."""
        result = np.eye(7)
        result[:3, :3], result[3:6, 3:6] = self.rotation, self.scale * self.rotation
        result[3:6, :3], result[3:6, 6] = skew(self.translation) @ self.rotation, -self.translation
        return result

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sim3):
            return NotImplemented
        same = np.array_equal(self.rotation, other.rotation) and np.array_equal(self.translation, other.translation)
        return same and self.scale == other.scale

    __hash__ = None  # type: ignore[assignment]  # arrays can change
