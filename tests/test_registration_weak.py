"""The gimbal's word on an image that only two references hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from onthefly3r.records import Attitude, Shot
from onthefly3r.registration.weak import MAX_TURN_DEG, attitudes_agree

# The map lies in the world turned and tilted: only turns between cameras can be compared.
MAP_FROM_ENU = rotation_exp(np.array([0.7, -0.4, 2.1]))
ATTITUDES = [Attitude(10.0, -90.0, 0.0), Attitude(175.0, -60.0, 2.0), Attitude(-80.0, -75.0, -1.0)]


def shot(attitude: Attitude | None) -> Shot:
    return Shot("a.jpg", Path("a.jpg"), 4000, 3000, "camera", 0.7, 0.02, "guess", attitude=attitude)


def pose(attitude: Attitude, turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Rigid3:
    """The pose in the map of a camera with these angles, turned about its own axes."""
    enu_from_cam = enu_from_cam_rotation(attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg)
    return Rigid3(MAP_FROM_ENU @ enu_from_cam @ rotation_exp(np.radians(turn_deg)), np.zeros(3))


REFERENCES = [(shot(a), pose(a)) for a in ATTITUDES[1:]]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("turn_deg", "agrees"), [(0.0, True), (MAX_TURN_DEG - 1.0, True), (MAX_TURN_DEG + 1.0, False)])
def test_a_camera_may_be_turned_by_what_a_gimbal_drifts(axis: int, turn_deg: float, agrees: bool) -> None:
    turned = pose(ATTITUDES[0], tuple(np.eye(3)[axis] * turn_deg))
    assert attitudes_agree(shot(ATTITUDES[0]), turned, REFERENCES) is agrees


def test_every_reference_must_agree() -> None:
    wrong = (REFERENCES[1][0], pose(ATTITUDES[2], (0.0, 0.0, 10.0)))
    assert not attitudes_agree(shot(ATTITUDES[0]), pose(ATTITUDES[0]), [REFERENCES[0], wrong])


def test_angles_that_are_not_told_confirm_nothing() -> None:
    assert not attitudes_agree(shot(None), pose(ATTITUDES[0]), REFERENCES)
    untold = [(replace(known, attitude=None), at) for known, at in REFERENCES]
    assert not attitudes_agree(shot(ATTITUDES[0]), pose(ATTITUDES[0]), untold)
    assert attitudes_agree(shot(ATTITUDES[0]), pose(ATTITUDES[0]), [untold[0], REFERENCES[1]])
