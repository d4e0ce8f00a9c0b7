"""What is known of a block apart from its images: camera positions, the level, ground control, as terms of a bundle.

All in one local east-north-up frame, metres. Every residual is divided by its standard deviation and robust (Huber),
horizontally and vertically apart, so that one bad value cannot bend the block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float, Int
from ..geometry.transforms import skew

HUBER_POSITION = 2.0  # standard deviations
HUBER_CONTROL = 3.0
LEVER = 3  # the last biases: the antenna from the camera, in the camera's axes
AXES = np.arange(3)


@dataclass(frozen=True)
class CameraTerms:
    """What the ties add to the normal equations of the poses and of the biases (B of them)."""

    poses: Float  # (I, 6, 6)
    poses_right: Float  # (I, 6)
    mixed: Float  # (I, 6, B)
    biases: Float  # (B, B)
    biases_right: Float  # (B,)


@dataclass(frozen=True)
class Ties:
    """Positions of cameras with a bias per flight and a lever arm, the level, and control points.

    The biases are east, north and up of each flight, then the lever arm. One whose sigma is 0 is held at zero.
    """

    position: Float  # (I, 3) m; any value where sigma is infinite
    sigma: Float  # (I, 3) m, infinite where nothing is known
    flight: Int  # (I,) number of the flight
    bias_sigma: Float  # (B,) m, three per flight, then 3 for the lever arm; 0 holds
    up: Float  # (I, 3) the upward direction in each camera's axes as far as known, unit length
    level_root: Float  # (I, 2, 2) root of the information of its east and north components; 0 where unknown
    control: Int  # (K,) rows of the points that are ground control
    control_m: Float  # (K, 3)
    control_sigma_m: Float  # (K, 3)

    def cost(self, rotations: Float, centres: Float, points: Float, biases: Float) -> float:
        """Return half the robust sum of squares of all terms."""
        residual = self.residuals(rotations, centres, biases)
        total = _huber_cost(_groups(residual), HUBER_POSITION).sum()
        level = np.linalg.norm(self._level(rotations), axis=1)
        total += _huber_cost(level, HUBER_POSITION).sum()
        held = self.bias_sigma == 0.0
        total += 0.5 * ((biases[~held] / self.bias_sigma[~held]) ** 2).sum()
        off = (self.control_m - points[self.control]) / self.control_sigma_m
        return float(total + _huber_cost(_groups(off), HUBER_CONTROL).sum())

    def residuals(self, rotations: Float, centres: Float, biases: Float) -> Float:
        """Return position minus camera (I, 3) once biases are taken off, in standard deviations; 0 where none is."""
        off = self.position - centres - rotations @ biases[-LEVER:] - biases[:-LEVER].reshape(-1, 3)[self.flight]
        return np.asarray(np.where(np.isfinite(self.sigma), off, 0.0) / self.sigma)

    def cameras(self, rotations: Float, centres: Float, biases: Float) -> CameraTerms:
        """Return what positions and level add to the normal equations of poses and biases."""
        n, n_biases = len(centres), len(biases)
        residual = self.residuals(rotations, centres, biases)
        root = np.sqrt(_huber_weight(_groups(residual), HUBER_POSITION))
        jacobian = np.zeros((n, 3, 6 + n_biases))  # of the modelled position
        jacobian[:, :, 3:6] = np.eye(3)
        jacobian[:, :, :3] = -rotations @ skew(biases[-LEVER:])
        jacobian[np.arange(n)[:, None], AXES, 6 + 3 * self.flight[:, None] + AXES] = 1.0
        jacobian[:, :, -LEVER:] = rotations
        root = np.repeat(root, (2, 1), axis=1)
        jacobian *= (root / self.sigma)[:, :, None]
        whole = np.swapaxes(jacobian, 1, 2) @ jacobian
        right = np.einsum("nkp,nk->np", jacobian, root * residual)
        level, turned = self._level(rotations), self._level_jacobian(rotations)
        heavy = _huber_weight(np.linalg.norm(level, axis=1), HUBER_POSITION)
        whole[:, :3, :3] += heavy[:, None, None] * (np.swapaxes(turned, 1, 2) @ turned)
        right[:, :3] -= heavy[:, None] * np.einsum("nkp,nk->np", turned, level)
        held = self.bias_sigma == 0.0
        mixed, biases_cc, biases_c = whole[:, :6, 6:], whole[:, 6:, 6:].sum(axis=0), right[:, 6:].sum(axis=0)
        mixed[:, :, held] = 0.0
        biases_cc[held], biases_cc[:, held], biases_c[held] = 0.0, 0.0, 0.0
        with np.errstate(divide="ignore"):
            information = np.where(held, 1.0, self.bias_sigma**-2.0)
        biases_cc = biases_cc + np.diag(information)
        biases_c = biases_c - np.where(held, 0.0, information * biases)
        return CameraTerms(whole[:, :6, :6], right[:, :6], mixed, biases_cc, biases_c)

    def points(self, points: Float) -> tuple[Float, Float]:
        """Return what control adds to the normal equations of its points: (K, 3, 3) and (K, 3)."""
        off = (self.control_m - points[self.control]) / self.control_sigma_m
        weight = np.repeat(_huber_weight(_groups(off), HUBER_CONTROL), (2, 1), axis=1) / self.control_sigma_m
        return (weight / self.control_sigma_m)[:, :, None] * np.eye(3), weight * off

    def _level(self, rotations: Float) -> Float:
        """Return the east and north components of the upward directions (I, 2), in standard deviations."""
        enu = np.einsum("nij,nj->ni", rotations, self.up)
        return np.asarray(np.einsum("nij,nj->ni", self.level_root, enu[:, :2]))

    def _level_jacobian(self, rotations: Float) -> Float:
        """Return its derivative (I, 2, 3) by a turn on the camera's side, R exp(w) u = R (u + w x u)."""
        crossed = -np.array([skew(u) for u in self.up])
        return np.asarray(self.level_root @ (rotations @ crossed)[:, :2])


def _groups(residual: Float) -> Float:
    """Return horizontal and vertical lengths (N, 2) of residuals (N, 3)."""
    return np.stack([np.hypot(residual[:, 0], residual[:, 1]), np.abs(residual[:, 2])], axis=1)


def _huber_cost(length: Float, threshold: float) -> Float:
    return np.where(length <= threshold, 0.5 * length**2, threshold * (length - 0.5 * threshold))


def _huber_weight(length: Float, threshold: float) -> Float:
    return np.asarray(np.minimum(1.0, threshold / np.maximum(length, 1e-12)))
