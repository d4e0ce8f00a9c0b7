"""A block of photographs as exact features: cameras over a hilly ground, points, and what each image sees of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from onthefly3r.backbones.local_sfm import SparseModel, Track
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from onthefly3r.records import Features, Shot

CAMERA = Camera(1000, 750, 800.0, 800.0, 500.0, 375.0, (-0.008, 0.006, 0.0005, -0.0003))
HEIGHT = 50.0
KEY = "camera"


@dataclass(frozen=True)
class Block:
    """The truth, and features (N, 2) of every image with the point behind each of them."""

    poses: Mapping[int, Rigid3]
    points: np.ndarray  # (P, 3)
    features: Mapping[int, Features]
    seen: Mapping[int, np.ndarray]  # point of each feature
    camera: Camera = CAMERA


def block(rows: int = 3, columns: int = 4, n_points: int = 900, noise_px: float = 0.0, seed: int = 0) -> Block:
    """Strips flown to and fro with 70 % overlap along and 60 % across, the cameras a little off nadir."""
    rng = np.random.default_rng(seed)
    step_x, step_y = 0.3 * HEIGHT * 1000 / 800, 0.4 * HEIGHT * 750 / 800
    poses, features, seen = {}, {}, {}
    x, y = rng.uniform(-25.0, step_x * columns + 25.0, n_points), rng.uniform(-20.0, step_y * rows + 20.0, n_points)
    points = np.stack([x, y, 4.0 * np.sin(x / 15.0) * np.cos(y / 11.0)], axis=1)
    for row in range(rows):
        for column in range(columns):
            heading = np.pi * (row % 2) + rng.normal(0.0, 0.05)
            tilt = rotation_exp(np.array([rng.normal(0.0, 0.03), rng.normal(0.0, 0.03), heading]))
            centre = np.array([step_x * column, step_y * row, HEIGHT + rng.normal(0.0, 1.0)])
            poses[row * columns + column] = Rigid3(tilt @ np.diag([1.0, -1.0, -1.0]), centre)
    for index, pose in poses.items():
        pixels = CAMERA.project(pose.inverse().apply(points))
        inside = np.flatnonzero(((pixels > 0.0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1))
        nothing = np.zeros(len(inside), np.float32)
        noisy = pixels[inside] + noise_px * rng.standard_normal((len(inside), 2))
        descriptors = np.zeros((len(inside), 128), np.uint8)
        features[index] = Features(noisy.astype(np.float32), nothing, nothing, descriptors)
        seen[index] = inside
    return Block(poses, points, features, seen)


def sparse_model(
    truth: Block, camera: Camera = CAMERA, turn_deg: float = 0.0, shift: float = 0.0, seed: int = 1
) -> SparseModel:
    """The block as structure from motion would answer it, every camera and point off by a random error."""
    rng = np.random.default_rng(seed)
    poses = {
        i: Rigid3(
            pose.rotation @ rotation_exp(np.radians(turn_deg) * rng.standard_normal(3)),
            pose.translation + shift * rng.standard_normal(3),
        )
        for i, pose in truth.poses.items()
    }
    points = truth.points + shift * rng.standard_normal(truth.points.shape)
    length = np.bincount(np.concatenate(list(truth.seen.values())), minlength=len(points))
    tracks = {i: Track(np.arange(len(seen)), seen) for i, seen in truth.seen.items()}
    return SparseModel(poses, {KEY: camera}, points, np.full(len(points), 0.5), length, tracks, 0.5)


def shots(truth: Block, focal_ratio: float = 0.8, sigma: float = 0.05) -> dict[int, Shot]:
    """Shots of the block's images, with what their tags say of the focal length."""
    return {
        i: Shot(f"{i}.jpg", Path(f"{i}.jpg"), CAMERA.width, CAMERA.height, KEY, focal_ratio, sigma, "exif 35 mm")
        for i in truth.poses
    }
