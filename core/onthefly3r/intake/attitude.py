"""Camera angles and flying heights in the tags of drones, brought to gimbal angles (pitch -90 looks down).

Which names mean what:
- DJI, `drone-dji:Gimbal*Degree`: north-east-down, order yaw, pitch, roll (DJI Mavic 3M user manual, "Photo File").
- Autel, `drone:Gimbal*Degree`: newer firmware, as DJI's; older firmware writes the `Camera` tags (OpenAthena's
  documentation of Autel's two formats).
- Parrot, `drone-parrot:Camera*Degree`: north-east-down (Parrot, "Embedded Photo Metadata", developer.parrot.com).
- Skydio, `drone-skydio:CameraOrientationNED`: a structure of Roll, Pitch, Yaw in north-east-down (Skydio support,
  "Skydio camera and metadata overview").
- Yuneec, `drone-yuneec:Gimbal*`, and `xmp:Camera*` of the CGO3+: north-east-down (packets in the documentation of
  EXIFupdate).
- senseFly, Wingtra, Sentera, MicaSense, Parrot, older Autel, `Camera:Yaw/Pitch/Roll`: Pix4D's convention, in which a
  camera of pitch 0 and roll 0 looks down (Pix4D support, "Specifications of XMP Camera Tags" and "Yaw, Pitch, Roll
  and Omega, Phi, Kappa angles").
"""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float
from ..geometry.frames import ENU_FROM_NED, gimbal_angles_deg
from ..records import Attitude
from .tags import Tags

MAX_ANGLE_DEG = 360.0
# Beyond these no gimbal turns a camera: past straight down by 60 degrees, or straight up.
LOWEST_PITCH_DEG, HIGHEST_PITCH_DEG = -150.0, 100.0
LOWEST_ABOVE_TAKEOFF_M, HIGHEST_ABOVE_TAKEOFF_M = -500.0, 20_000.0

# Names of yaw, pitch and roll of cameras that count from the horizon.
_GIMBALS = (
    ("drone-dji:GimbalYawDegree", "drone-dji:GimbalPitchDegree", "drone-dji:GimbalRollDegree"),
    ("drone:GimbalYawDegree", "drone:GimbalPitchDegree", "drone:GimbalRollDegree"),
    ("drone-parrot:CameraYawDegree", "drone-parrot:CameraPitchDegree", "drone-parrot:CameraRollDegree"),
    (
        "drone-skydio:CameraOrientationNED/Yaw",
        "drone-skydio:CameraOrientationNED/Pitch",
        "drone-skydio:CameraOrientationNED/Roll",
    ),
    ("drone-yuneec:GimbalYaw", "drone-yuneec:GimbalPitch", "drone-yuneec:GimbalRoll"),
    ("xmp:CameraYaw", "xmp:CameraPitch", "xmp:CameraRoll"),
)
_BODY = ("Camera:Yaw", "Camera:Pitch", "Camera:Roll")  # of a camera that looks down when the aircraft is level
_ABOVE_TAKEOFF = (
    "drone-dji:RelativeAltitude",
    "drone:RelativeAltitude",
    "drone-skydio:RelativeAltitude",
    "drone-yuneec:AboveHomeAltitude",
    "Camera:AboveGroundAltitude",
)
# Axes of a camera that looks down (x right, y to the tail, z down) in the aircraft's (forward, right, down).
_BODY_FROM_CAMERA = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def read_attitude(tags: Tags) -> tuple[Attitude | None, tuple[str, ...]]:
    """Return the camera's angles and what was odd about them; None unless all three are there and possible."""
    for names in _GIMBALS:
        if any(name in tags.xmp for name in names):
            angles = _angles(tags, names)
            if angles is None:
                return None, ("camera angles are incomplete or no angles: left out",)
            if angles == (0.0, 0.0, 0.0):
                return None, ("camera angles are all zero, which drones write when they were not measured: left out",)
            if not LOWEST_PITCH_DEG <= angles[1] <= HIGHEST_PITCH_DEG:
                return None, (f"a camera pitch of {angles[1]:g} degrees is not possible: the angles are left out",)
            return Attitude(*angles), ()
    angles = _angles(tags, _BODY)
    if angles is None or angles == (0.0, 0.0, 0.0):
        return None, ()
    return gimbal_of_body(*angles), ()


def read_above_takeoff_m(tags: Tags) -> float | None:
    """Return the flying height above the take-off point or the ground that the drone states."""
    return tags.xmp_number(*_ABOVE_TAKEOFF, low=LOWEST_ABOVE_TAKEOFF_M, high=HIGHEST_ABOVE_TAKEOFF_M)


def gimbal_of_body(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Attitude:
    """Return the gimbal angles of a camera that looks down from an aircraft of these angles (Pix4D, OpenDroneMap).

    The aircraft is turned by yaw, pitch and roll about its down, right and forward axes; a roll swings the view aside.
    """
    ned_from_body = _turn(2, yaw_deg) @ _turn(1, pitch_deg) @ _turn(0, roll_deg)
    yaw, pitch, roll = gimbal_angles_deg(ENU_FROM_NED @ ned_from_body @ _BODY_FROM_CAMERA)
    return Attitude(yaw, pitch, roll)


def _turn(axis: int, angle_deg: float) -> Float:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    r = np.eye(3)
    r[i, i] = r[j, j] = c
    r[i, j], r[j, i] = -s, s
    return r


def _angles(tags: Tags, names: tuple[str, str, str]) -> tuple[float, float, float] | None:
    yaw, pitch, roll = (tags.xmp_number(name, low=-MAX_ANGLE_DEG, high=MAX_ANGLE_DEG) for name in names)
    return None if yaw is None or pitch is None or roll is None else (yaw, pitch, roll)
