"""Photographs as stored: pixels go there and back, and the stored camera sees every point where its file shows it."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.orientation import is_turn, stored_camera, stored_pixels, stored_pose, upright_pixels
from onthefly3r.geometry.transforms import Rigid3, rotation_exp

UPRIGHT = Camera(1200, 1600, 1310.0, 1305.0, 612.0, 788.0, (-0.04, 0.02, 0.003, -0.002))
POSE = Rigid3(rotation_exp(np.array([0.3, -0.2, 0.9])), np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_go_there_and_back(orientation: int) -> None:
    pixels = np.random.default_rng(0).uniform(0, 1200, (20, 2))
    stored = stored_pixels(pixels, 1200, 1600, orientation)
    assert np.allclose(upright_pixels(stored, 1200, 1600, orientation), pixels)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_turned_as_pillow_turns_them(orientation: int) -> None:
    from PIL import Image, ImageOps

    shape = (6, 4) if orientation < 5 else (4, 6)
    stored = Image.fromarray(np.zeros((*shape, 3), np.uint8))
    stored.putpixel((1, 2), (255, 0, 0))
    exif = stored.getexif()
    exif[0x0112] = orientation
    upright = np.array(ImageOps.exif_transpose(stored))
    row, column = np.argwhere(upright[:, :, 0] == 255)[0]
    found = stored_pixels(np.array([column + 0.5, row + 0.5]), upright.shape[1], upright.shape[0], orientation)
    assert np.allclose(found, (1.5, 2.5))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_stored_camera_sees_what_its_file_shows(orientation: int) -> None:
    assert is_turn(orientation)
    in_camera = np.random.default_rng(1).uniform((-0.4, -0.5, 0.9), (0.4, 0.5, 1.2), (30, 3))
    points = POSE.apply(in_camera)
    expected = stored_pixels(UPRIGHT.project(in_camera), 1200, 1600, orientation)
    camera, pose = stored_camera(UPRIGHT, orientation), stored_pose(POSE, orientation)
    assert np.isclose(np.linalg.det(pose.rotation), 1.0)
    assert np.allclose(camera.project(pose.inverse().apply(points)), expected)


def test_a_mirrored_file_is_no_image_of_a_camera() -> None:
    assert [code for code in range(1, 9) if not is_turn(code)] == [2, 4, 5, 7]
