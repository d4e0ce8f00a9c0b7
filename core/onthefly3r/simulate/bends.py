"""Bends of space that grow with the extent of a local model, as joint reconstructions show them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, rotation_exp

BendForm = Literal["bowl", "saddle", "cylinder"]
BEND_FORMS: dict[BendForm, Float] = {
    "bowl": np.diag([1.0, 1.0]),
    "saddle": np.diag([1.0, -1.0]),
    "cylinder": np.diag([1.0, 0.0]),
}


@dataclass(frozen=True, eq=False)
class Bend:
    """A bend of space: the ground rises with the offset r by r' S r / R^2 and |c| (r . c/|c|)^3 / R^3.

    Plumb lines stay normal to the ground.
    """

    middle: Float  # (3,) ENU m; its height does not matter
    sags_m: Float  # (2, 2) S, about east and north; a bowl has the same sag in all directions
    radius_m: float  # R
    cubic_m: Float = field(default_factory=lambda: np.zeros(2))  # (2,) c, its direction that of the rise

    @property
    def is_flat(self) -> bool:
        """Whether nothing is bent."""
        return not (self.sags_m.any() or self.cubic_m.any())

    def apply(self, points: Float) -> Float:
        """Bend points (..., 3) in ENU."""
        offset = (points - self.middle)[..., :2]
        quadratic, cubic = self._slopes(points)
        # By Euler's theorem the rise of second order is half of r . slope, that of third order a third of it.
        rise = np.sum(offset * (quadratic / 2.0 + cubic / 3.0), axis=-1, keepdims=True)
        return np.asarray(points + np.concatenate([-points[..., 2:] * (quadratic + cubic), rise], axis=-1))

    def apply_to_pose(self, enu_from_cam: Rigid3) -> Rigid3:
        """Bend a camera: it moves with the place where it is and turns with the slope there."""
        quadratic, cubic = self._slopes(enu_from_cam.translation)
        slope = quadratic + cubic
        turn = rotation_exp(np.array([slope[1], -slope[0], 0.0]))
        return Rigid3(turn @ enu_from_cam.rotation, self.apply(enu_from_cam.translation))

    def _slopes(self, points: Float) -> tuple[Float, Float]:
        """Return the slopes (..., 2) of second and of third order."""
        offset = (points - self.middle)[..., :2]
        quadratic = 2.0 / self.radius_m**2 * offset @ self.sags_m
        size_m = float(np.linalg.norm(self.cubic_m))
        if size_m == 0.0:
            return np.asarray(quadratic), np.zeros_like(quadratic)
        along = offset @ (self.cubic_m / size_m)
        return np.asarray(quadratic), np.asarray(3.0 / self.radius_m**3 * along[..., None] ** 2 * self.cubic_m)
