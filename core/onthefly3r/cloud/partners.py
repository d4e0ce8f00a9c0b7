"""Which photographs see the same ground well enough to be matched with, or to be compared with.

The worth of a partner is that of the points of a photograph which it sees too: a log-normal of the angle between the
two rays, less where the scales differ. Points that an earlier partner covers well are worth less to a later one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.arrays import Float
from .views import View

BEST_ANGLE_DEG = 14.0  # between the rays: wide enough to be precise, small enough to match
ANGLE_SPREAD = 0.6  # standard deviation of its logarithm
SCALE_SPREAD = 0.5  # standard deviation of the logarithm of the ratio of ground sampling distances
COVERED = 0.45  # of its worth that a point loses to a partner that sees it at the best angle
LEAST_OVERLAP = 0.1  # share of the points that a partner must see,
LEAST_WORTH = 0.02  # and what they must be worth on average
CANDIDATES = 60  # nearest photographs that are looked at
SAMPLED_POINTS = 300
MARGIN_PX = 4.0


class Overlaps:
    """Ranks, for each photograph, the others by what they see of it."""

    def __init__(self, views: Mapping[int, View]) -> None:
        from scipy.spatial import cKDTree

        self._views = views
        self._seeing = [index for index, view in views.items() if len(view.points)]
        middles = np.array([_place(views[index]) for index in self._seeing]).reshape(-1, 6)
        self._middles = dict(zip(self._seeing, middles, strict=True))
        self._tree = cKDTree(middles) if self._seeing else None

    def partners(self, index: int, count: int) -> list[int]:
        """Return up to `count` other photographs, best first."""
        if self._tree is None or index not in self._middles:
            return []
        points = self._views[index].points
        points = points[:: max(1, len(points) // SAMPLED_POINTS)].astype(float)
        _, nearest = self._tree.query(self._middles[index], min(CANDIDATES + 1, len(self._seeing)))
        others = sorted(self._seeing[row] for row in np.atleast_1d(nearest) if self._seeing[row] != index)
        values = {other: value for other in others if (value := self._values(index, other, points)) is not None}
        worth, chosen = np.ones(len(points)), list[int]()
        while values and len(chosen) < count:
            best = max(values, key=lambda other: (float(values[other] @ worth), -other))
            if values[best] @ worth < LEAST_WORTH * len(points):
                break
            worth = worth * (1.0 - COVERED * values.pop(best))
            chosen.append(best)
        return chosen

    def _values(self, index: int, other: int, points: Float) -> Float | None:
        """Return what each point is worth to the pair, None where they overlap too little."""
        first, second = self._views[index], self._views[other]
        in_second = second.level_from_cam.inverse().apply(points)
        pixels = second.grid.project(in_second)
        size = np.array([second.grid.width, second.grid.height])
        shared = ((pixels >= MARGIN_PX) & (pixels < size - MARGIN_PX)).all(axis=-1)  # False at NaN
        if np.count_nonzero(shared) < LEAST_OVERLAP * len(points):
            return None
        rays = [points - view.level_from_cam.translation for view in (first, second)]
        length = [np.linalg.norm(ray, axis=-1) for ray in rays]
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = (rays[0] * rays[1]).sum(axis=-1) / (length[0] * length[1])
            finer = np.log(length[0] * second.grid.fx / (length[1] * first.grid.fx)) / SCALE_SPREAD
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        wider = np.log(np.maximum(angle, 0.01) / BEST_ANGLE_DEG) / ANGLE_SPREAD
        return np.where(shared, np.exp(-0.5 * (wider**2 + finer**2)), 0.0)


def _place(view: View) -> Float:
    """Return where a photograph was taken and the middle of what it sees (6,): near ones look at the same."""
    return np.concatenate([view.level_from_cam.translation, np.median(view.points, axis=0)])
