"""The ground plane of the map, when there is one: which way is up without any position."""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float
from ..map.state import MapState

SAMPLES_PER_FRAME = 60
TRIALS = 300
TOLERANCE = 0.03  # of the median distance from camera to ground
MIN_SHARE = 0.5


def ground_normal(state: MapState, seed: int = 0) -> Float | None:
    """Return the unit normal (3,) of the dominant plane, towards the cameras; None when less than half lies on one."""
    rng = np.random.default_rng(seed)
    points = np.vstack([_sample(state, i, rng) for i in state.frames])
    centres = np.array([state.map_from_cam(i).translation for i in state.frames])
    if len(points) < 100:
        return None
    best: tuple[int, Float] | None = None
    depth = float(np.median(np.linalg.norm(points - np.median(centres, axis=0), axis=1)))
    for _ in range(TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length == 0:
            continue
        normal = normal / length
        share = int((np.abs((points - a) @ normal) < TOLERANCE * depth).sum())
        if best is None or share > best[0]:
            best = share, np.stack([normal, a])
    if best is None or best[0] < MIN_SHARE * len(points):
        return None
    normal, origin = best[1]
    on_plane = points[np.abs((points - origin) @ normal) < TOLERANCE * depth]
    centred = on_plane - on_plane.mean(axis=0)
    refined = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    towards_cameras = np.sign((np.median(centres, axis=0) - on_plane.mean(axis=0)) @ refined)
    return np.asarray(refined * (towards_cameras or 1.0))


def _sample(state: MapState, index: int, rng: np.random.Generator) -> Float:
    points = state.reference(index).points.astype(float)
    chosen = points[rng.permutation(len(points))[:SAMPLES_PER_FRAME]]
    return state.submap_pose_of(index).apply(chosen)
