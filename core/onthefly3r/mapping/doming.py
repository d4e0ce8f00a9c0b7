"""Doming: the bend that a lens or a network gone slightly wrong gives to all that it rebuilds at once.

A bent local model is a dish: at a distance r from its middle it rises by c r^2 / 2 and slopes by c r, c being its
curvature. Ground keeps its size, and every camera stays above the ground that it sees, for its depth is right and
neighbouring rays still meet there: h above the ground, it shifts by -c h r too. Self-calibrated models of parallel
photographs bend like this (James and Robson, Earth Surface Processes and Landforms 39, 2014, p. 1413).

All views of a local model turn alike with its bend, so that a graph of poses, which takes the errors of views for
independent, spreads it over the map. Here the curvature of each submap is estimated from how it disagrees with others
about the frames they share, as far as it stands out from the noise of views. A bend that all have in common shows in no
disagreement; only positions could tell it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, rotation_exp
from ..records import Sighting
from .sightings import ViewNoise, misfits_at_camera, motion_at_camera
from .state import MapState

LEVEL = 0.05  # of the scene's depth: how far cameras are off a plane square to the direction in which they look
OUTLYING = 3.0  # times the noise: views that miss by more were placed wrong, and count the less
ROUNDING = 1e-9  # of what a bend does to the views: less of it left than that is none
WIDE = 10.0  # times what one submap leaves open: the spread of curvatures to begin with
STEPS = 30  # of estimating that spread


@dataclass(frozen=True)
class Dish:
    """What the bend of a submap is about, in its frame and units."""

    middle: Float  # (3,) of the cameras
    up: Float  # (3,) away from the scene, square to the plane of the cameras
    height: float  # of the cameras above the scene

    def bend(self, centre: Float) -> Float:
        """Return [turn in rad, shift] (6,) of a camera at a place (3,), for a curvature of one."""
        offset = centre - self.middle
        flat = offset - (offset @ self.up) * self.up
        return np.concatenate([np.cross(flat, self.up), 0.5 * (flat @ flat) * self.up - self.height * flat])

    def straighten(self, centre: Float, curvature: float) -> Sim3:
        """Return straight_from_bent for what a camera at a place (3,) sees."""
        turn, shift = np.split(-curvature * self.bend(centre), 2)
        rotation = rotation_exp(turn)
        return Sim3(1.0, rotation, centre + shift - rotation @ centre)


def dishes(state: MapState) -> dict[int, Dish]:
    """Return the dish of every submap: its cameras, new ones and references, and how far below them the scene is."""
    poses: dict[int, list[Rigid3]] = {}
    depths: dict[int, list[float]] = {}
    for frame in state.frames.values():
        poses.setdefault(frame.submap, []).append(frame.submap_from_cam)
        depths.setdefault(frame.submap, []).append(frame.depth)
    for seen in state.sightings:
        poses.setdefault(seen.submap, []).append(seen.submap_from_cam)
    return {submap: dish(poses[submap], float(np.median(depths[submap]))) for submap in depths}


def dish(poses: Sequence[Rigid3], depth: float) -> Dish:
    """Return the dish of cameras that see the scene at a depth along their axes.

    Cameras along a line leave its roll open, one camera everything: there `up` is against the direction of view.
    """
    centres = np.array([pose.translation for pose in poses])
    axis = np.mean([pose.rotation[:, 2] for pose in poses], axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    offsets = centres - centres.mean(axis=0)
    spread = offsets.T @ offsets + len(poses) * (LEVEL * depth) ** 2 * (np.eye(3) - np.outer(axis, axis))
    up = np.linalg.eigh(spread)[1][:, 0]
    slant = float(up @ axis)
    return Dish(centres.mean(axis=0), up if slant < 0.0 else -up, depth * abs(slant))


@dataclass(frozen=True)
class Doming:
    """How much every submap is bent."""

    dish_of: Mapping[int, Dish]
    curvature_of: Mapping[int, float]  # per unit of the submap

    def straight_from_bent(self, submap: int, centre: Float) -> Sim3:
        """Return what straightens the surroundings of a camera at a place (3,) in a submap."""
        return self.dish_of[submap].straighten(centre, self.curvature_of[submap])

    def straightened(self, sightings: Sequence[Sighting]) -> list[Sighting]:
        """Return sightings as the submaps would have them if they were not bent."""
        straight = []
        for seen in sightings:
            straight_from_bent = self.straight_from_bent(seen.submap, seen.submap_from_cam.translation)
            straight.append(replace(seen, frame_from_submap=seen.frame_from_submap @ straight_from_bent.inverse()))
        return straight


def found_so_far(state: MapState) -> Doming:
    """Return how bent the submaps of a map were found; those that are new are taken to be flat."""
    dish_of = dishes(state)
    return Doming(dish_of, dict.fromkeys(dish_of, 0.0) | state.curvature_of)


def estimate(
    nodes: Mapping[int, Sim3], sightings: Sequence[Sighting], dish_of: Mapping[int, Dish], noise: ViewNoise
) -> Doming:
    """Return the most likely curvature of each submap, given where the frames are.

    Curvatures are drawn around zero; how widely is estimated with them (empirical Bayes), so that none is made up where
    the misfits show none.

    Args:
        nodes: submaps and frames in the map, numbered as in the pose graph.
        sightings: as the submaps have them, bent.
        dish_of: what each submap bends about.
        noise: of views.
    """
    misfits = misfits_at_camera(nodes, sightings)
    rows_of: dict[int, list[int]] = {}
    for row, seen in enumerate(sightings):
        rows_of.setdefault(seen.submap, []).append(row)
    told = np.array(
        [
            _told(misfits[rows], [sightings[row] for row in rows], dish_of[submap], nodes[submap].scale, noise)
            for submap, rows in rows_of.items()
        ]
    )
    in_map = dict.fromkeys(dish_of, 0.0) | dict(zip(rows_of, _most_likely(*told.T).tolist(), strict=True))
    return Doming(dish_of, {submap: nodes[submap].scale * value for submap, value in in_map.items()})


def _told(misfits: Float, seen: Sequence[Sighting], dish: Dish, scale: float, noise: ViewNoise) -> tuple[float, float]:
    """Return what the misfits (N, 7) of a submap tell of its curvature per map unit: information, and that times it."""
    in_map = np.array([1.0] * 3 + [scale] * 3 + [1.0])
    centres = [one.submap_from_cam.translation for one in seen]
    # 1 per map unit is `scale` per unit of the submap.
    bent = np.array([scale * in_map * np.append(dish.bend(centre), 0.0) for centre in centres])
    moved = np.array([motion_at_camera(centre) * in_map[:, None] for centre in centres])
    whitened = np.dstack([misfits[:, :, None], bent[:, :, None], moved]) / noise.sigmas[:, None]
    length = np.sqrt((whitened[:, :, 0] ** 2).mean(axis=1))
    whitened *= np.sqrt(np.minimum(1.0, OUTLYING / np.maximum(length, 1e-12)))[:, None, None]
    missed, bends, moves = np.split(whitened.reshape(-1, 9), [1, 2], axis=1)
    # What moving the submap as a whole explains says nothing of its bend.
    basis = np.linalg.qr(moves)[0]
    shape = bends - basis @ (basis.T @ bends)
    information = float((shape * shape).sum())
    if information < ROUNDING * float((bends * bends).sum()):
        return 0.0, 0.0
    return information, float((shape * missed).sum())


def _most_likely(information: Float, toward: Float) -> Float:
    """Return the means of normal variables drawn around zero, of which so much is told; how widely they are drawn too.

    Expectation-maximisation, from a spread that hides nothing.
    """
    if not information.any():
        return np.zeros(len(information))
    variance = WIDE / float(np.median(information[information > 0.0]))
    found = np.zeros(len(information))
    for _ in range(STEPS):
        left = 1.0 / (information + 1.0 / variance)
        found = left * toward
        variance = float(np.mean(found**2 + left))
    return found
