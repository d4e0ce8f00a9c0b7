"""Small local models of a hilly ground, made without ray casting, for tests of single stages.

The map frame is the world in metres: cameras hang 100 m over the mean ground and look straight down.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.records import CompactReference, LocalModel, LocalView
from onthefly3r.registration.references import compact_reference

CAMERA = Camera(56, 42, 48.0, 48.0, 28.0, 21.0)
HEIGHT_M = 100.0
MAP_FROM_LOCAL = Sim3(80.0, rotation_exp(np.array([0.4, -1.1, 2.0])), np.array([300.0, -200.0, 50.0]))


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 4.0 * np.sin(x / 25.0) * np.cos(y / 20.0)


def world_from_cam(index: int) -> Rigid3:
    """Cameras in rows of five, 25 m apart; their headings differ."""
    yaw = 0.3 * index
    nadir = np.diag([1.0, -1.0, -1.0])
    return Rigid3(
        rotation_exp(np.array([0.0, 0.0, yaw])) @ nadir, np.array([25.0 * (index % 5), 25.0 * (index // 5), HEIGHT_M])
    )


def true_view(index: int, noise_m: float = 0.0, rng: np.random.Generator | None = None) -> LocalView:
    """What the camera sees of the ground, in the map frame; `noise_m` is the standard deviation along the ray."""
    pose = world_from_cam(index)
    rays = pose.rotation @ CAMERA.rays(CAMERA.pixel_centres()).reshape(-1, 3).T
    depth = np.full(rays.shape[1], HEIGHT_M)
    for _ in range(30):
        x, y, _ = pose.translation[:, None] + depth * rays
        depth = (HEIGHT_M - ground(x, y)) / -rays[2]
    if rng is not None:
        depth = depth + noise_m * rng.standard_normal(len(depth))
    points = (pose.translation[:, None] + depth * rays).T.reshape(CAMERA.height, CAMERA.width, 3)
    confidence = np.full(points.shape[:2], 0.9, np.float32)
    return LocalView(CAMERA, PixelMap(0.01, 0.01), pose, points.astype(np.float32), confidence)


def moved(view: LocalView, target_from_source: Sim3) -> LocalView:
    """The same view in another frame."""
    return replace(
        view,
        local_from_cam=target_from_source.apply_to_pose(view.local_from_cam),
        points=target_from_source.apply(view.points.astype(float)).astype(np.float32),
    )


def local_model(
    indices: Sequence[int],
    noise_m: float = 0.1,
    seed: int = 0,
    bad: Mapping[int, Rigid3] | None = None,
    map_from_local: Sim3 = MAP_FROM_LOCAL,
) -> LocalModel:
    """A local model of some cameras in a frame of its own; `bad` ones are moved in the world beforehand."""
    rng = np.random.default_rng(seed)
    views = {}
    for index in indices:
        view = true_view(index, noise_m, rng)
        if bad and index in bad:
            wrong = bad[index]
            view = moved(view, Sim3(1.0, wrong.rotation, wrong.translation))
        views[index] = moved(view, map_from_local.inverse())
    return LocalModel(views)


def misplaced(index: int, turn_deg: float, shift_m: float, seed: int = 0) -> Rigid3:
    """A motion of the world that turns camera `index` about its own centre and shifts it, in random directions."""
    rng = np.random.default_rng((seed, index))
    axis, direction = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    rotation = rotation_exp(np.radians(turn_deg) * axis)
    centre = world_from_cam(index).translation
    return Rigid3(rotation, centre - rotation @ centre + shift_m * direction)


def true_references(indices: Sequence[int], max_points: int = 400) -> dict[int, CompactReference]:
    return {i: compact_reference(true_view(i), max_points, 0.5) for i in indices}
