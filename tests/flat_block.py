"""A block of nadir photographs over flat, textured ground: exact depth maps, and pictures by homography."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from onthefly3r.cloud.views import View, pinhole
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from onthefly3r.records import Shot

WIDTH, HEIGHT, FOCAL, ALTITUDE = 320, 240, 220.0, 40.0
DOWN = np.diag([1.0, -1.0, -1.0])  # level_from_cam of a camera that looks straight down, its top to the north
TEXEL = 0.06  # m


def flat_block(columns: int = 3, rows: int = 2, step: float = 10.0, folder: Path | None = None) -> dict[int, View]:
    """Photographs `step` m apart, turned a little, in an order of their own; with a folder their pictures exist."""
    rng = np.random.default_rng(5)
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    views = {}
    for number in range(columns * rows):
        centre = np.array([step * (number % columns), step * (number // columns), ALTITUDE])
        pose = Rigid3(DOWN @ rotation_exp(0.02 * rng.standard_normal(3)), centre + 0.3 * rng.standard_normal(3))
        name = f"{number:02d}.png"
        path = (folder or Path()) / name
        shot = Shot(name, path, WIDTH, HEIGHT, "camera", FOCAL / WIDTH, 0.01, "option")
        pixels = rng.uniform((0, 0), (WIDTH, HEIGHT), (200, 2))
        view = View(shot, 0, camera, pinhole(camera), pose, on_ground(camera, pose, pixels).astype(np.float32))
        views[10 + number] = view
        if folder is not None:
            cv2.imwrite(str(path), picture(view))
    return views


def on_ground(camera: Camera, pose: Rigid3, pixels: np.ndarray) -> np.ndarray:
    rays = camera.rays(pixels) @ pose.rotation.T
    return pose.translation + rays * (-pose.translation[2] / rays[..., 2])[..., None]


def ground_depth(view: View) -> np.ndarray:
    """The exact depth map (H, W) of the ground in the view's grid."""
    rays = view.grid.rays(view.grid.pixel_centres()) @ view.level_from_cam.rotation.T
    return (-view.level_from_cam.translation[2] / rays[..., 2]).astype(np.float32)


def picture(view: View) -> np.ndarray:
    """What the camera sees (H, W, 3) of a ground of smoothed noise."""
    rng = np.random.default_rng(9)
    texture = sum(
        cv2.resize(rng.uniform(0, 255, (side, side, 3)).astype(np.float32), (2400, 2400), interpolation=cv2.INTER_CUBIC)
        for side in (150, 400, 1200)
    )
    texture = np.clip(texture / 3.0, 0, 255).astype(np.uint8)
    level = view.level_from_cam
    to_pixels = view.camera.matrix() @ level.rotation.T
    ground = np.column_stack([to_pixels[:, :2], -to_pixels @ level.translation])  # of (east, north, 1), heights 0
    metres = np.array([[TEXEL, 0.0, -60.0], [0.0, TEXEL, -60.0], [0.0, 0.0, 1.0]])
    half = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    return cv2.warpPerspective(texture, half @ ground @ metres, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
