from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.earth.ground import ground_normal
from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.records import CompactReference, Frame, NewFrame, Submap

CAMERA = Camera(56, 42, 48.0, 48.0, 28.0, 21.0)
MAP_FROM_ENU = Sim3(0.02, rotation_exp(np.array([0.5, -1.2, 0.8])), np.array([3.0, 1.0, -2.0]))
UP = MAP_FROM_ENU.rotation[:, 2]


def state_over(work: Path, height_of: object, frames: int = 12, points: int = 200) -> MapState:
    """Cameras 100 m over ground whose height is a function of (x, y, random generator)."""
    state, rng = MapState(Store(work)), np.random.default_rng(0)
    for k in range(frames):
        centre = np.array([20.0 * k, 15.0 * (k % 3), 100.0])
        x, y = centre[:2, None] + 40.0 * rng.uniform(-1.0, 1.0, (2, points))
        ground = np.column_stack([x, y, height_of(x, y, rng)])  # type: ignore[operator]
        reference = CompactReference(np.zeros((points, 2), np.int32), ground.astype(np.float32), np.ones(points))
        frame = Frame(k, k, CAMERA, PixelMap(1.0, 1.0), Rigid3(np.diag([1.0, -1.0, -1.0]), centre), 1.0)
        empty = np.zeros((0, 3), np.float32)
        new = NewFrame(frame, reference, empty, empty.astype(np.uint8), np.zeros(0, np.uint8))
        state.commit(Submap(k, MAP_FROM_ENU, (frame,), ()), [new])
    return state


def angle_deg(normal: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(normal @ UP, -1.0, 1.0))))


def test_flat_ground_with_a_few_houses_tells_up(tmp_path: Path) -> None:
    def height(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.where(rng.random(x.shape) < 0.25, rng.uniform(4.0, 20.0, x.shape), 0.3 * rng.standard_normal(x.shape))

    normal = ground_normal(state_over(tmp_path, height))
    assert normal is not None and np.linalg.norm(normal) == pytest.approx(1.0)
    assert angle_deg(normal) < 0.5  # towards the cameras, not away from them


def test_a_slope_is_followed(tmp_path: Path) -> None:
    normal = ground_normal(state_over(tmp_path, lambda x, y, rng: 0.2 * x))
    assert normal is not None
    assert angle_deg(normal) == pytest.approx(np.degrees(np.arctan(0.2)), abs=0.5)


def test_rough_ground_tells_nothing(tmp_path: Path) -> None:
    assert ground_normal(state_over(tmp_path, lambda x, y, rng: rng.uniform(0.0, 60.0, x.shape))) is None


def test_too_few_points_tell_nothing(tmp_path: Path) -> None:
    assert ground_normal(state_over(tmp_path, lambda x, y, rng: 0.0 * x, frames=2, points=20)) is None
