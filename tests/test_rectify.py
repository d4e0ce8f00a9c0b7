"""Rectification: rows, disparities and pixel centres against the projection of the cameras themselves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from onthefly3r.backbones.rectify import Rectification, rectify
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, rotation_exp

LEFT = Camera(400, 300, 280.0, 282.0, 203.0, 147.0, (-0.05, 0.02, 4e-4, -3e-4))
RIGHT = Camera(360, 300, 290.0, 290.0, 178.0, 151.0, (0.04, 0.0, -2e-4, 1e-4))
angle = st.floats(-np.pi, np.pi)
tilt = st.floats(-0.12, 0.12)


def pair(heading: float, turn_left: float, turn_right: float, tilts: tuple[float, float]) -> tuple[Rigid3, Rigid3]:
    """Two cameras that look along z, turned about it and tilted a little, one unit apart."""
    left = Rigid3(rotation_exp(np.array([tilts[0], tilts[1], 0.0])) @ rotation_exp(np.array([0.0, 0.0, turn_left])))
    right = rotation_exp(np.array([-tilts[1], tilts[0], 0.0])) @ rotation_exp(np.array([0.0, 0.0, turn_right]))
    return left, Rigid3(right, np.array([np.cos(heading), np.sin(heading), 0.1]))


def ground(count: int = 200) -> np.ndarray:
    """Points four to six units in front of the cameras."""
    rng = np.random.default_rng(0)
    return rng.uniform((-1.0, -1.0, 4.0), (2.0, 2.0, 6.0), (count, 3))


def right_pixels(found: Rectification, in_camera: np.ndarray) -> np.ndarray:
    turned = in_camera @ found.rect_from_right.T
    return found.focal_px * turned[:, :2] / turned[:, 2:] + (found.centre[0] + found.offset_px, found.centre[1])


@settings(max_examples=40, deadline=None)
@given(angle, angle, angle, st.tuples(tilt, tilt))
def test_point_lies_in_one_row_and_its_disparity_is_its_depth(
    heading: float, turn_left: float, turn_right: float, tilts: tuple[float, float]
) -> None:
    left, right = pair(heading, turn_left, turn_right, tilts)
    points = ground()
    found = rectify(LEFT, left, RIGHT, right, points, 280.0, 1.0)
    assert found is not None
    in_left = left.inverse().apply(points)
    rays = (in_left / in_left[:, 2:])[None]
    pixels, z = found.pixels(rays)
    other = right_pixels(found, right.inverse().apply(points))
    np.testing.assert_allclose(pixels[0, :, 1], other[:, 1], atol=1e-4)
    disparity = pixels[0, :, 0] - other[:, 0]
    assert (disparity > 0.0).all()
    assert (disparity < found.disparities).all()
    np.testing.assert_allclose(found.depth(disparity), in_left[:, 2] * z[0], rtol=1e-4)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, np.pi, 2.5])
def test_images_show_what_the_cameras_see(turn: float) -> None:
    """Images whose grey value is their own pixel coordinate tell where each rectified pixel was taken from."""
    left, right = pair(0.4, turn, -turn, (0.05, -0.08))
    found = rectify(LEFT, left, RIGHT, right, ground(), 280.0, 1.0)
    assert found is not None
    x, y = np.meshgrid(np.arange(found.width), np.arange(found.height))
    for axis in (0, 1):
        ramps = [camera.pixel_centres()[..., axis].astype(np.float32) + 1.0 for camera in (LEFT, RIGHT)]
        images = found.images(ramps[0], LEFT, ramps[1], RIGHT)
        shifts = (0.0, found.offset_px)
        rotations = (found.rect_from_left, found.rect_from_right)
        for image, camera, shift, rect_from_cam in zip(images, (LEFT, RIGHT), shifts, rotations, strict=True):
            cx, cy = found.centre[0] + shift, found.centre[1]
            turned = np.stack([(x - cx) / found.focal_px, (y - cy) / found.focal_px, np.ones(x.shape)], axis=-1)
            expected = camera.project(turned @ rect_from_cam)
            size = np.array([camera.width, camera.height])
            inside = ((expected > 1.0) & (expected < size - 1.0)).all(axis=-1)
            assert inside.mean() > 0.2
            assert np.abs(image - 1.0 - expected[..., axis])[inside].max() < 0.05  # OpenCV interpolates in 1/32 px
            outside = ((expected < -1.0) | (expected > size + 1.0)).any(axis=-1)
            assert (image[outside] == 0).all()


@pytest.mark.parametrize(("heading", "turn"), [(0.0, 0.0), (1.0, 2.0), (np.pi, 0.3)])
def test_window_holds_everything_both_images_see(heading: float, turn: float) -> None:
    left, right = pair(heading, 0.3, turn, (0.02, 0.05))
    points = ground(6000) * (4.0, 4.0, 1.0)
    found = rectify(LEFT, left, RIGHT, right, points, 280.0, 1.0)
    assert found is not None
    in_left, in_right = left.inverse().apply(points), right.inverse().apply(points)
    seen = np.ones(len(points), bool)
    for camera, in_camera in ((LEFT, in_left), (RIGHT, in_right)):
        pixels = camera.project(in_camera)
        seen &= ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=-1)
    assert seen.sum() > 500
    pixels, _ = found.pixels((in_left / in_left[:, 2:])[None])
    inside = (pixels[0] > (found.disparities - 1.0, -1.0)) & (pixels[0] < (found.width, found.height))
    assert inside[seen].all()


def test_nearer_surfaces_widen_the_search() -> None:
    left, right = pair(0.0, 0.0, 0.0, (0.0, 0.0))
    plain, wide = (rectify(LEFT, left, RIGHT, right, ground(), 280.0, nearer) for nearer in (1.0, 1.8))
    assert plain is not None
    assert wide is not None
    assert wide.depth(np.array(float(wide.disparities))) < 1.01 * 4.0 / 1.8 < plain.depth(np.array(plain.disparities))


@pytest.mark.parametrize(
    "step", [np.zeros(3), np.array([0.1, 0.0, 1.0]), np.array([0.0, -0.2, -1.0])], ids=["none", "ahead", "back"]
)
def test_no_rectification_without_baseline_across_the_view(step: np.ndarray) -> None:
    assert rectify(LEFT, Rigid3(), RIGHT, Rigid3(np.eye(3), step), ground(), 280.0, 1.0) is None


def test_no_rectification_of_views_apart() -> None:
    away = Rigid3(rotation_exp(np.array([0.0, 2.0, 0.0])), np.array([1.0, 0.0, 0.0]))
    assert rectify(LEFT, Rigid3(), RIGHT, away, ground(), 280.0, 1.0) is None
    behind = ground() * (1.0, 1.0, -1.0)
    assert rectify(LEFT, Rigid3(), RIGHT, Rigid3(np.eye(3), np.array([1.0, 0, 0])), behind, 280.0, 1.0) is None
