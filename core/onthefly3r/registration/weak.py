"""A second opinion on an image that few references hold: the gimbal angles in the tags."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.frames import enu_from_cam_rotation
from ..geometry.transforms import Rigid3, rotation_angle_deg
from ..records import Shot

MAX_TURN_DEG = 4.0  # gimbals drift by a degree or two against each other, yaw more


def attitudes_agree(shot: Shot, map_from_cam: Rigid3, references: Sequence[tuple[Shot, Rigid3]]) -> bool:
    """Return whether an image is turned against its references as the gimbal says; False where it says nothing.

    A wrong match of pictures puts a camera anywhere; that its attitude then fits to a few degrees about three axes
    has a chance of less than one in a thousand.
    """
    if shot.attitude is None:
        return False
    told = enu_from_cam_rotation(shot.attitude.yaw_deg, shot.attitude.pitch_deg, shot.attitude.roll_deg)
    turns = []
    for other, map_from_other in references:
        if other.attitude is not None:
            angles = other.attitude
            expected = told.T @ enu_from_cam_rotation(angles.yaw_deg, angles.pitch_deg, angles.roll_deg)
            found = map_from_cam.rotation.T @ map_from_other.rotation
            turns.append(rotation_angle_deg(expected.T @ found))
    return len(turns) > 0 and float(np.max(turns)) <= MAX_TURN_DEG
