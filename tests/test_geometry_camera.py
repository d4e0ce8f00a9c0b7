from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.geometry.camera import Camera, PixelMap

seeds = st.integers(0, 2**32 - 1)
DRONE = (-0.015, 0.0147, 0.0014, -0.0027)
CANON = (-0.155, 0.124, 0.0002, 0.0004)
lenses = st.sampled_from([(0.0, 0.0, 0.0, 0.0), DRONE, CANON])


def camera(distortion: tuple[float, float, float, float] = DRONE) -> Camera:
    return Camera(1600, 1200, 1211.8, 1213.7, 803.0, 596.5, distortion)


@given(seed=seeds, distortion=lenses)
def test_projection_agrees_with_opencv(seed: int, distortion: tuple[float, float, float, float]) -> None:
    points = np.random.default_rng(seed).uniform((-2, -1.5, 3.0), (2, 1.5, 6.0), (20, 3))
    lens = camera(distortion)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix(), np.array(distortion))
    assert np.allclose(lens.project(points), expected[:, 0], atol=1e-8)


@given(seed=seeds, distortion=lenses)
def test_rays_are_the_inverse_of_projection(seed: int, distortion: tuple[float, float, float, float]) -> None:
    lens = camera(distortion)
    pixels = np.random.default_rng(seed).uniform((0, 0), (1600, 1200), (30, 2))
    rays = lens.rays(pixels)
    assert np.allclose(rays[:, 2], 1.0)
    assert np.allclose(lens.project(rays * 7.3), pixels, atol=1e-4)


def test_points_behind_are_nan() -> None:
    assert np.isnan(camera().project(np.array([[0.0, 0.0, -1.0], [0.1, 0.0, 0.0]]))).all()


def test_pixel_centres() -> None:
    centres = Camera(3, 2, 1.0, 1.0, 1.5, 1.0).pixel_centres()
    assert centres.shape == (2, 3, 2)
    assert centres[1, 2] == pytest.approx([2.5, 1.5])


@given(seed=seeds, distortion=lenses)
def test_a_camera_through_a_pixel_map_sees_mapped_pixels(
    seed: int, distortion: tuple[float, float, float, float]
) -> None:
    rng = np.random.default_rng(seed)
    pixel_map = PixelMap(*rng.uniform(0.2, 3.0, 2), *rng.uniform(-50, 50, 2))
    points = rng.uniform((-2, -1.5, 3.0), (2, 1.5, 6.0), (10, 3))
    lens = camera(distortion)
    assert np.allclose(lens.through(pixel_map, 10, 10).project(points), pixel_map.apply(lens.project(points)))
    assert np.allclose(pixel_map.inverse().apply(pixel_map.apply(points[:, :2])), points[:, :2])


def test_resizing_keeps_the_corners() -> None:
    lens = Camera(4000, 3000, 3000.0, 3000.0, 2000.0, 1500.0)
    small = lens.resized(1000, 750)
    assert (small.width, small.height, small.fx, small.cx, small.cy) == (1000, 750, 750.0, 500.0, 375.0)
    corner = np.array([[4000.0, 3000.0]])
    assert np.allclose(small.rays(corner / 4.0), lens.rays(corner))
