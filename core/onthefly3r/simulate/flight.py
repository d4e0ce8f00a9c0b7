"""Flight plans: true camera poses over a scene, and what the drone's receiver and gimbal say of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import OptionError
from ..geometry.arrays import Float
from ..geometry.camera import Camera
from ..geometry.frames import enu_from_cam_rotation, gimbal_angles_deg
from ..geometry.geodesy import EnuFrame, undulation_m
from ..geometry.transforms import Rigid3, rotation_exp
from ..option_fields import CheckedOptions, option
from ..records import Attitude, GpsFix, VerticalReference
from .scene import Scene, make_scene

DEFAULT_ORIGIN = EnuFrame(lat_deg=48.2, lon_deg=15.6, height_m=300.0)
RTK_FIXED = 50  # DJI RtkFlag
FOCAL_RATIO = 0.68  # focal length / image width: what 24 mm (35-mm equivalent) promises, give or take 2 %
START_TIME_S = 1717236000.0  # 2024-06-01 10:00:00 UTC
SHOT_INTERVAL_S = 2.0
TURN_TIME_S = 12.0
JITTER_DEG = 1.2  # standard deviation of the gimbal about its set attitude, per axis
JITTER_M = 0.4  # standard deviation of the position about the plan, per axis
GIMBAL_SIGMA_DEG = 0.3  # standard deviation of the angles in the tags
GAP_IMAGES = 3  # images missing in a row


@dataclass(frozen=True)
class SurveyOptions(CheckedOptions):
    """A survey to be simulated; the defaults are the demo survey."""

    images: int = option(40, "photographs", unit="images", minimum=3, maximum=20000)
    strips: int = option(4, "parallel flight strips (of each direction in a cross flight)", unit="strips", minimum=1)
    plan: Literal["strips", "oblique", "cross"] = option(
        "strips",
        "strips: nadir; oblique: camera pitched to -75 degrees; cross: two perpendicular sets of oblique strips",
        choices=("strips", "oblique", "cross"),
    )
    altitude_m: float = option(80.0, "flying height above the mean ground", unit="m", minimum=10.0, maximum=1000.0)
    forward_overlap: float = option(0.8, "overlap of consecutive photographs", minimum=0.0, maximum=0.98)
    side_overlap: float = option(0.65, "overlap of neighbouring strips", minimum=0.0, maximum=0.98)
    image_width_px: int = option(1000, "width of the photographs", unit="px", minimum=200, maximum=8000)
    image_height_px: int = option(750, "height of the photographs", unit="px", minimum=200, maximum=8000)
    distorted: bool = option(False, "give the lens radial and tangential distortion")
    rtk: bool = option(
        True, "write the tags of an RTK drone, with ellipsoidal heights; otherwise above the EGM96 geoid"
    )
    gps_sigma_h_m: float = option(0.03, "horizontal noise of the positions in the tags", unit="m", minimum=0.0)
    gps_sigma_v_m: float = option(0.05, "vertical noise of the positions in the tags", unit="m", minimum=0.0)
    height_bias_m: float = option(
        0.0, "standard deviation of the height offset that all positions of one flight share", unit="m", minimum=0.0
    )
    gaps: int = option(0, "places where three photographs in a row are missing", unit="gaps", minimum=0)
    look_alike: bool = option(False, "repeat the same block of houses all over the scene")
    seed: int = option(0, "everything is drawn from this number", minimum=0)


@dataclass(frozen=True)
class TrueView:
    """One photograph: the truth, and what its tags will say."""

    name: str
    camera: Camera  # at photograph size
    enu_from_cam: Rigid3
    gps: GpsFix  # noisy, as written into the tags
    attitude: Attitude  # noisy
    time_s: float
    flight: int


@dataclass(frozen=True, eq=False)
class Survey:
    """A scene, the views of it in capture order, and its place on the Earth."""

    scene: Scene
    views: tuple[TrueView, ...]
    origin: EnuFrame  # where the local east-north-up frame touches the Earth
    options: SurveyOptions


def plan_survey(options: SurveyOptions, origin: EnuFrame | None = None) -> Survey:
    """Return the flight over a landscape that is made to fit it; raises `OptionError` for an impossible plan."""
    origin = origin or DEFAULT_ORIGIN
    rng = np.random.default_rng((options.seed, 1))
    camera = _camera(options)
    stations = _remove_gaps(_stations(options, camera), options, rng)
    positions = np.array([s.position for s in stations]) + JITTER_M * rng.standard_normal((len(stations), 3))
    reach_m = options.altitude_m * (0.9 if options.plan == "strips" else 1.3) + 20.0
    (west, south), (east, north) = positions[:, :2].min(axis=0) - reach_m, positions[:, :2].max(axis=0) + reach_m
    scene = make_scene(
        (float(west), float(south), float(east), float(north)), options.seed, look_alike=options.look_alike
    )
    n_flights = 1 + max(s.flight for s in stations)
    bias_m = options.height_bias_m * rng.standard_normal(n_flights)
    sigma = np.array([options.gps_sigma_h_m, options.gps_sigma_h_m, options.gps_sigma_v_m])
    measured = positions + sigma * rng.standard_normal(positions.shape)
    measured[:, 2] += bias_m[[s.flight for s in stations]]
    fixes = _gps_fixes(measured, origin, options)
    views = []
    for number, (station, position, fix) in enumerate(zip(stations, positions, fixes, strict=True), start=1):
        rotation = enu_from_cam_rotation(station.yaw_deg, station.pitch_deg, 0.0)
        rotation = rotation @ rotation_exp(np.radians(JITTER_DEG) * rng.standard_normal(3))
        told = rotation @ rotation_exp(np.radians(GIMBAL_SIGMA_DEG) * rng.standard_normal(3))
        views.append(
            TrueView(
                name=f"SIM_{number:04d}.JPG",
                camera=camera,
                enu_from_cam=Rigid3(rotation, position),
                gps=fix,
                attitude=Attitude(*gimbal_angles_deg(told)),
                time_s=station.time_s,
                flight=station.flight,
            )
        )
    return Survey(scene, tuple(views), origin, options)


@dataclass(frozen=True, eq=False)
class _Station:
    """A planned exposure."""

    position: Float  # (3,) ENU m
    yaw_deg: float
    pitch_deg: float
    time_s: float
    flight: int


def _camera(options: SurveyOptions) -> Camera:
    focal_px = FOCAL_RATIO * max(options.image_width_px, options.image_height_px)
    distortion = (-0.08, 0.02, 4e-4, -3e-4) if options.distorted else (0.0, 0.0, 0.0, 0.0)
    width, height = options.image_width_px, options.image_height_px
    # A real principal point is a little off the middle.
    return Camera(width, height, focal_px, focal_px, 0.501 * width, 0.4985 * height, distortion)


def _stations(options: SurveyOptions, camera: Camera) -> list[_Station]:
    """Return the planned exposures; the long side of the image lies across the flight direction."""
    base_m = (1.0 - options.forward_overlap) * camera.height / camera.fy * options.altitude_m
    spacing_m = (1.0 - options.side_overlap) * camera.width / camera.fx * options.altitude_m
    pitch_deg = -90.0 if options.plan == "strips" else -75.0
    # (heading of the first strip, images) of each flight
    flights = [(90.0, options.images)]
    if options.plan == "cross":
        flights = [(90.0, (options.images + 1) // 2), (0.0, options.images // 2)]
    if options.strips > min(count for _, count in flights):
        raise OptionError(
            f"strips: {options.strips} strips need as many images per flight, {options.images} images are too few"
        )
    stations: list[_Station] = []
    time_s = START_TIME_S
    for flight, (heading_deg, count) in enumerate(flights):
        forward, right = _directions(heading_deg)
        for strip, members in enumerate(np.array_split(np.arange(count), options.strips)):
            way = 1.0 if strip % 2 == 0 else -1.0  # serpentine
            for i in range(len(members)):
                along = way * (i - (len(members) - 1) / 2) * base_m
                across = (strip - (options.strips - 1) / 2) * spacing_m
                position = np.append(along * forward + across * right, options.altitude_m)
                yaw_deg = heading_deg if way > 0 else heading_deg + 180.0
                stations.append(_Station(position, yaw_deg, pitch_deg, time_s, flight))
                time_s += SHOT_INTERVAL_S
            time_s += TURN_TIME_S
        time_s += 600.0  # landing, another battery
    return stations


def _directions(heading_deg: float) -> tuple[Float, Float]:
    """Return unit vectors (2,) east-north along a heading and to its right."""
    heading = math.radians(heading_deg)
    forward = np.array([math.sin(heading), math.cos(heading)])
    return forward, np.array([forward[1], -forward[0]])


def _remove_gaps(stations: list[_Station], options: SurveyOptions, rng: np.random.Generator) -> list[_Station]:
    """Drop runs of exposures, never the first or last ones."""
    missing: set[int] = set()
    for _ in range(options.gaps):
        start = int(rng.integers(2, max(3, len(stations) - GAP_IMAGES - 2)))
        missing.update(range(start, start + GAP_IMAGES))
    if len(stations) - len(missing) < 3:
        raise OptionError(f"gaps: {options.gaps} gaps leave fewer than 3 of {options.images} images")
    return [s for i, s in enumerate(stations) if i not in missing]


def _gps_fixes(positions: Float, origin: EnuFrame, options: SurveyOptions) -> list[GpsFix]:
    """Return positions (N, 3) in local ENU as the fixes that an RTK drone (ellipsoidal) or another (EGM96) writes."""
    geographic = origin.to_geographic(positions)
    vertical = tag_vertical(options)
    geographic[:, 2] -= undulation_m(vertical, geographic[:, 0], geographic[:, 1])
    sigma_h_m, sigma_v_m = (options.gps_sigma_h_m, options.gps_sigma_v_m) if options.rtk else (None, None)
    rtk = RTK_FIXED if options.rtk else None
    return [
        GpsFix(float(lat_deg), float(lon_deg), float(height_m), vertical, sigma_h_m, sigma_v_m, rtk)
        for lat_deg, lon_deg, height_m in geographic
    ]


def tag_vertical(options: SurveyOptions) -> VerticalReference:
    """Return what the heights in the tags refer to."""
    return "ellipsoidal" if options.rtk else "egm96"
