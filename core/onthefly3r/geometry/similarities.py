"""Many similarities at once, as arrays: what `Sim3` is, for all nodes or edges of a graph."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .arrays import Float, Int
from .transforms import Rigid3, Sim3, rotation_exp, rotation_log, skew, translation_jacobian

# x / (1 - exp(-x)) = 1 + x / 2 + sum of B_n x^n / n! over even n.
_BERNOULLI = (1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160, -691 / 1307674368000)
_NEAR = 0.4  # rad plus logarithm of scale, up to which that many terms give all digits
_TERMS = 40  # of a power series, for angles up to half a turn and scales up to 1000


@dataclass(frozen=True)
class Similarities:
    """N transforms target_from_source(p) = scale * rotation @ p + translation."""

    scale: Float  # (N,)
    rotation: Float  # (N, 3, 3)
    translation: Float  # (N, 3)

    @classmethod
    def of(cls, transforms: Iterable[Sim3 | Rigid3]) -> Similarities:
        """Stack transforms; rigid ones have scale 1."""
        many = list(transforms)
        return cls(
            np.array([t.scale if isinstance(t, Sim3) else 1.0 for t in many], float),
            np.array([t.rotation for t in many], float).reshape(-1, 3, 3),
            np.array([t.translation for t in many], float).reshape(-1, 3),
        )

    @classmethod
    def shifts(cls, translations: Float) -> Similarities:
        """Return the transforms that only move by translations (N, 3)."""
        count = len(translations)
        return cls(np.ones(count), np.broadcast_to(np.eye(3), (count, 3, 3)), translations)

    @classmethod
    def exp(cls, twists: Float) -> Similarities:
        """Return the transforms of twists (N, 7) [rotation rad, translation, log scale]."""
        w, log_scale = twists[:, :3], twists[:, 6]
        moved = translation_jacobian(w, log_scale) @ twists[:, 3:6, None]
        return cls(np.exp(log_scale), rotation_exp(w), moved[:, :, 0])

    def log(self) -> Float:
        """Return the twists (N, 7): the inverse of `exp`."""
        w, log_scale = rotation_log(self.rotation), np.log(self.scale)
        u = np.linalg.solve(translation_jacobian(w, log_scale), self.translation[:, :, None])
        return np.concatenate([w, u[:, :, 0], log_scale[:, None]], axis=1)

    def tangent(self) -> Float:
        """Return [rotation rad, translation, log scale] (N, 7), which is the twist only near the identity."""
        parts = [rotation_log(self.rotation), self.translation, np.log(self.scale)[:, None]]
        return np.concatenate(parts, axis=1)

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(self, rows: Int | Sequence[int] | slice) -> Similarities:
        return Similarities(self.scale[rows], self.rotation[rows], self.translation[rows])

    def single(self, row: int) -> Sim3:
        """Return one of them."""
        return Sim3(float(self.scale[row]), self.rotation[row].copy(), self.translation[row].copy())

    def apply(self, points: Float) -> Float:
        """Map one point each (N, 3)."""
        turned = (self.rotation @ points[:, :, None])[:, :, 0]
        return np.asarray(self.scale[:, None] * turned + self.translation)

    def inverse(self) -> Similarities:
        """Return source_from_target of each."""
        rotation = self.rotation.swapaxes(1, 2)
        moved = (rotation @ self.translation[:, :, None])[:, :, 0]
        return Similarities(1.0 / self.scale, rotation, -moved / self.scale[:, None])

    def __matmul__(self, other: Similarities) -> Similarities:
        """Compose pair by pair: (c_from_b @ b_from_a) = c_from_a."""
        return Similarities(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))

    def adjoint(self) -> Float:
        """Return Ad (N, 7, 7) with T exp(x) T^-1 = exp(Ad x)."""
        result = np.zeros((len(self), 7, 7))
        result[:, :3, :3], result[:, 3:6, 3:6] = self.rotation, self.scale[:, None, None] * self.rotation
        result[:, 3:6, :3], result[:, 3:6, 6] = skew(self.translation) @ self.rotation, -self.translation
        result[:, 6, 6] = 1.0
        return result


def log_derivative(twists: Float) -> Float:
    """Return the derivatives (N, 7, 7) of log(T exp(d)) by d at d = 0, at log(T) = twists (N, 7).

    The inverse of the group's right Jacobian: x / (1 - exp(-x)) of the matrix x that stands for [twist, .].
    """
    ad = _bracket(twists)
    far = np.sqrt((twists[:, :3] ** 2).sum(axis=1)) + np.abs(twists[:, 6]) > _NEAR
    square = ad @ ad
    power, result = square, np.eye(7) + ad / 2.0 + _BERNOULLI[0] * square
    for factor in _BERNOULLI[1:]:
        power = power @ square
        result += factor * power
    if far.any():
        jacobian = np.broadcast_to(np.eye(7), ad[far].shape)
        for n in range(_TERMS, 1, -1):  # (1 - exp(-x)) / x by Horner's rule
            jacobian = np.eye(7) - ad[far] @ jacobian / n
        result[far] = np.linalg.inv(jacobian)
    return np.asarray(result)


def _bracket(twists: Float) -> Float:
    """Return the matrices (N, 7, 7) of the Lie bracket with twists."""
    result = np.zeros((len(twists), 7, 7))
    k = skew(twists[:, :3])
    result[:, :3, :3], result[:, 3:6, :3] = k, skew(twists[:, 3:6])
    result[:, 3:6, 3:6] = k + twists[:, 6, None, None] * np.eye(3)
    result[:, 3:6, 6] = -twists[:, 3:6]
    return result
