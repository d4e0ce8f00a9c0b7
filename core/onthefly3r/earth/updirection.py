"""What tells which way is up apart from positions: gimbal angles, ground plane, and how drone cameras hang.

Positions alone are a poor level: consumer receivers drift by tens of metres in height during a flight, which a
similarity fit takes for a tilted survey. Each witness here is a few rows "direction . up = 0 within sigma".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float
from ..geometry.frames import enu_from_cam_rotation
from ..geometry.transforms import Rigid3, skew
from ..records import Shot

GIMBAL_SIGMA_DEG = 1.5  # offset of a flight's gimbal; single frames scatter less
GROUND_SIGMA_DEG = 5.0  # natural slope of the ground under a survey
LEVEL_SIGMA_DEG = 4.0  # the image's horizontal edge against the horizon
NADIR_SIGMA_DEG = 10.0  # mean viewing direction against straight down
WITNESS_CORE = 4.0  # squared sigmas beyond which a witness counts as mistaken
LOOKS_UP = 0.34  # sine of the angle above the horizon (20 degrees) at which cameras of a survey do not look
MAX_AXIS_SPREAD_DEG = 40.0  # beyond this viewing directions tell nothing about nadir


@dataclass(frozen=True)
class UpWitness:
    """Rows direction . up = 0, in the map frame."""

    name: str
    directions: Float  # (K, 3) map frame, unit length
    sigma: Float  # (K,) rad


def up_witnesses(
    map_from_cam: Mapping[int, Rigid3],
    shots: Mapping[int, Shot],
    ground_normal: Float | None,
    use_angles: bool = True,
) -> tuple[Float, list[UpWitness]]:
    """Return a first up vector (3,) in the map frame and the witnesses behind it.

    The points lie before the cameras: that side is down, and gimbal angles which say that the cameras look up at them
    do not count. With gimbal angles, the habits of drone cameras (level image edge, mean view to nadir) are left out.

    Args:
        map_from_cam: poses of the placed cameras, map frame.
        shots: their tags.
        ground_normal: (3,) away from the ground (up), map frame; None if unknown.
        use_angles: whether gimbal angles may speak.
    """
    images = sorted(map_from_cam)
    gimbal = _gimbal_up(images, map_from_cam, shots) if use_angles else None
    if gimbal is not None and _looks_up(gimbal[0], map_from_cam):
        gimbal = None
    witnesses: list[UpWitness] = []
    sign = -_mean_view(map_from_cam)
    if ground_normal is not None:
        ground = np.asarray(ground_normal, float) / float(np.linalg.norm(ground_normal))
        witnesses.append(_vector_witness("ground plane", ground, GROUND_SIGMA_DEG))
        sign = ground
    if gimbal is not None:
        witnesses.append(gimbal[1])
        sign = gimbal[0]
    else:
        witnesses += _habits(np.array([map_from_cam[i].rotation for i in images]))
    return fuse(witnesses, sign), witnesses


def angles_look_up(map_from_cam: Mapping[int, Rigid3], shots: Mapping[int, Shot]) -> bool:
    """Return whether there are gimbal angles and they say that the cameras look up at what they photograph."""
    gimbal = _gimbal_up(sorted(map_from_cam), map_from_cam, shots)
    return gimbal is not None and _looks_up(gimbal[0], map_from_cam)


def _looks_up(up: Float, map_from_cam: Mapping[int, Rigid3]) -> bool:
    return float(up @ _mean_view(map_from_cam)) > LOOKS_UP


def _mean_view(map_from_cam: Mapping[int, Rigid3]) -> Float:
    return np.asarray(np.mean([pose.rotation[:, 2] for pose in map_from_cam.values()], axis=0))


def fuse(witnesses: Sequence[UpWitness], sign: Float) -> Float:
    """Return the unit vector that fits all rows best, on the side of `sign`; outvoted witnesses lose weight."""
    weights = np.ones(len(witnesses))
    up = np.asarray(sign, float)
    for _ in range(20):
        information = 1e-6 * (np.eye(3) - np.outer(up, up) / float(up @ up))
        for witness, weight in zip(witnesses, weights, strict=True):
            rows = witness.directions / witness.sigma[:, None]
            information = information + weight * rows.T @ rows
        up = np.linalg.eigh(information)[1][:, 0]
        up = up if float(up @ sign) >= 0.0 else -up
        weights = np.array([cauchy_weight(squared_misfit(w, up)) for w in witnesses])
    return np.asarray(up)


def squared_misfit(witness: UpWitness, up: Float) -> float:
    """Return how far an up vector is from a witness, squared, in its sigmas."""
    return float((((witness.directions @ up) / witness.sigma) ** 2).sum())


def cauchy_weight(squared: float, core: float = WITNESS_CORE) -> float:
    """Return the IRLS weight of `cauchy_cost`."""
    return 1.0 / (1.0 + squared / core)


def cauchy_cost(squared: float, core: float = WITNESS_CORE) -> float:
    """Return the heavy-tailed cost that starts as half the squared misfit."""
    return 0.5 * core * float(np.log1p(squared / core))


def _gimbal_up(
    images: Sequence[int], map_from_cam: Mapping[int, Rigid3], shots: Mapping[int, Shot]
) -> tuple[Float, UpWitness] | None:
    """Return the robust mean of the up vectors that gimbal angles give; yaw cancels out."""
    vectors = []
    for i in images:
        attitude = shots[i].attitude
        if attitude is not None:
            enu_from_cam = enu_from_cam_rotation(attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg)
            vectors.append(map_from_cam[i].rotation @ enu_from_cam[2])
    if not vectors:
        return None
    ups = np.array(vectors)
    mean, weight = np.median(ups, axis=0), np.ones(len(ups))
    for _ in range(20):
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        distance = np.linalg.norm(ups - mean, axis=1)
        scatter = max(1.4826 * float(np.median(distance)), np.radians(0.2))
        weight = 1.0 / np.maximum(1.0, distance / (1.5 * scatter))
        mean = weight @ ups / weight.sum()
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    # Angles that contradict each other are worth as little as they scatter.
    sigma_deg = float(np.hypot(GIMBAL_SIGMA_DEG, np.degrees(scatter) / (3.0 if len(ups) > 9 else len(ups) ** 0.5)))
    return mean, _vector_witness("gimbal angles", mean, sigma_deg)


def _habits(rotations: Float) -> list[UpWitness]:
    """Return the witnesses of camera axes (N, 3, 3): image edges are level, and the mean view is straight down."""
    # Level edges: up is at right angles to every camera's x axis; well determined once headings differ.
    x_axes, views = rotations[:, :, 0], rotations[:, :, 2]
    shares, directions = np.linalg.eigh(x_axes.T @ x_axes / len(x_axes))
    shares = np.maximum(shares, 0.0)
    sigma = np.hypot(np.radians(LEVEL_SIGMA_DEG), np.sqrt(shares[0]))
    kept = shares > 1e-3
    kept[0] = False  # the direction least seen by x axes is up itself
    witnesses = []
    if kept.any():
        witnesses.append(UpWitness("level image edges", directions.T[kept], sigma / np.sqrt(shares[kept])))
    mean = views.mean(axis=0)
    length = float(np.linalg.norm(mean))
    spread_deg = float(np.degrees(np.arccos(min(1.0, length))))
    if spread_deg < MAX_AXIS_SPREAD_DEG:
        witnesses.append(
            _vector_witness("mean viewing direction", -mean / length, float(np.hypot(NADIR_SIGMA_DEG, spread_deg)))
        )
    return witnesses


def _vector_witness(name: str, up: Float, sigma_deg: float) -> UpWitness:
    least = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = skew(up) @ least
    first = first / float(np.linalg.norm(first))
    return UpWitness(name, np.stack([first, skew(up) @ first]), np.full(2, np.radians(sigma_deg)))
