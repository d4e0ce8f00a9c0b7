from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from PIL.TiffImagePlugin import IFDRational

from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.intake.attitude import gimbal_of_body, read_above_takeoff_m, read_attitude
from onthefly3r.intake.position import read_fix
from onthefly3r.intake.tags import Tags, finite
from onthefly3r.records import Attitude, GpsFix

GPS = {
    "GPSLatitudeRef": "N",
    "GPSLatitude": (46.0, 50.0, 33.3855),
    "GPSLongitudeRef": "W",
    "GPSLongitude": (91.0, 59.0, 40.4156),
    "GPSAltitudeRef": b"\x00",
    "GPSAltitude": 198.309,
}
EXACT = {"drone-dji:GpsLatitude": "46.84260708", "drone-dji:GpsLongtitude": "-91.99455989"}


def whole(*parts: float) -> tuple[IFDRational, ...]:
    return tuple(IFDRational(int(part), 1) for part in parts)


def fix(gps: dict[str, Any] | None = None, **more: Any) -> GpsFix:
    found, _ = read_fix(Tags(gps={**GPS, **(gps or {})}, **more))
    assert found is not None
    return found


def test_degrees_minutes_seconds_and_hemispheres() -> None:
    found = fix()
    assert found.lat_deg == pytest.approx(46.0 + 50.0 / 60 + 33.3855 / 3600, abs=1e-12)
    assert found.lon_deg == pytest.approx(-(91.0 + 59.0 / 60 + 40.4156 / 3600), abs=1e-12)
    assert found.height_m == 198.309
    assert found.vertical == "unknown"


@pytest.mark.parametrize(
    ("missing", "sign"), [("GPSLatitudeRef", (1, -1)), ("GPSLongitudeRef", (1, 1))], ids=["latitude", "longitude"]
)
def test_a_missing_hemisphere_is_assumed_and_said(missing: str, sign: tuple[int, int]) -> None:
    found, warnings = read_fix(Tags(gps={k: v for k, v in GPS.items() if k != missing}))
    assert found is not None
    assert (math.copysign(1, found.lat_deg), math.copysign(1, found.lon_deg)) == sign
    assert any(missing in warning and "assumed" in warning for warning in warnings)


def test_missing_hemispheres_come_from_the_xmp_position() -> None:
    gps = {name: value for name, value in GPS.items() if not name.endswith("tudeRef")}
    found, warnings = read_fix(Tags(gps=gps, xmp=EXACT))
    assert found is not None
    assert (found.lat_deg, found.lon_deg) == pytest.approx((46.84260708, -91.99455989), abs=1e-7)
    assert any("the signs of the XMP position" in warning for warning in warnings)
    assert not any("differ" in warning for warning in warnings)


@pytest.mark.parametrize(
    ("gps", "apart"),
    [
        ({"GPSLatitude": whole(46, 50, 33), "GPSLongitude": whole(91, 59, 40)}, True),
        ({"GPSLatitude": whole(46, 50, 0), "GPSLongitude": whole(91, 59, 0)}, True),
        ({"GPSLongitudeRef": "E", "GPSLatitude": whole(46, 50, 33), "GPSLongitude": whole(91, 59, 40)}, True),
    ],
    ids=["whole seconds", "whole minutes", "coarse and on the wrong side"],
)
def test_the_finer_source_and_its_sign_count_and_the_difference_is_told(gps: dict[str, Any], apart: bool) -> None:
    found, warnings = read_fix(Tags(gps={**GPS, **gps}, xmp=EXACT))
    assert found is not None
    assert (found.lat_deg, found.lon_deg) == (46.84260708, -91.99455989)
    assert any("differ" in warning and "XMP's was taken" in warning for warning in warnings) == apart


def test_a_corrected_exif_position_is_kept_beside_what_the_drone_wrote() -> None:
    """Correction programs rewrite EXIF to the millimetre and leave the XMP as it was."""
    moved = {**EXACT, "drone-dji:GpsLatitude": "46.84270000"}
    found, warnings = read_fix(Tags(gps=GPS, xmp=moved))
    assert found is not None
    assert found.lat_deg == pytest.approx(46.0 + 50.0 / 60 + 33.3855 / 3600, abs=1e-12)
    assert any("EXIF's was taken" in warning for warning in warnings)


@pytest.mark.parametrize(
    "gps",
    [
        {},
        {"GPSLatitude": (0.0, 0.0, 0.0), "GPSLongitude": (0.0, 0.0, 0.0)},
        {"GPSLatitude": (IFDRational(0, 0),) * 3, "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (math.nan, 0.0, 0.0), "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (95.0, 0.0, 0.0), "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (1e300, 0.0, 0.0), "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (), "GPSLongitude": "east"},
        {"GPSLatitude": (47.0, 0.0, 0.0)},
    ],
    ids=["nothing", "null island", "0/0", "nan", "off the Earth", "absurd", "text", "half"],
)
def test_no_fix_is_said(gps: dict[str, Any]) -> None:
    found, warnings = read_fix(Tags(gps=gps))
    assert found is None
    assert warnings


@pytest.mark.parametrize(
    ("reference", "version", "height", "vertical"),
    [
        (b"\x00", b"0230", 198.309, "unknown"),
        (b"\x01", b"0230", -198.309, "unknown"),
        (1, b"0230", -198.309, "unknown"),
        (None, b"0230", 198.309, "unknown"),
        (0, b"0300", 198.309, "ellipsoidal"),
        (2, b"0300", 198.309, "egm96"),
        (3, b"0300", -198.309, "egm96"),
        (0, b"9" * 5000, 198.309, "unknown"),
        (1e300, b"0300", 198.309, "ellipsoidal"),
    ],
)
def test_exif_altitude_reference(reference: Any, version: bytes, height: float, vertical: str) -> None:
    found = fix({"GPSAltitudeRef": reference}, exif={"ExifVersion": version})
    assert (found.height_m, found.vertical) == (height, vertical)


@pytest.mark.parametrize(
    ("xmp", "vertical", "rtk"),
    [
        ({}, "egm96", None),
        ({"RtkFlag": "0"}, "egm96", 0),
        ({"RtkFlag": "50"}, "ellipsoidal", 50),
        ({"RtkFlag": "34"}, "ellipsoidal", 34),
        ({"RtkFlag": "16"}, "ellipsoidal", 16),
        ({"AltitudeType": "RtkAlt"}, "ellipsoidal", None),
        ({"AltitudeType": "GpsFusionAlt"}, "egm96", None),
        ({"AltitudeType": "GpsFusionAlt", "RtkFlag": "50"}, "unknown", 50),
        ({"RtkFlag": "1e300"}, "egm96", None),
    ],
)
def test_dji_altitude_reference(xmp: dict[str, str], vertical: str, rtk: int | None) -> None:
    tags = {"AbsoluteAltitude": "+521.30", **xmp}
    found = fix(xmp={f"drone-dji:{name}": value for name, value in tags.items()})
    assert (found.height_m, found.vertical, found.rtk) == (521.3, vertical, rtk)


@pytest.mark.parametrize(
    ("xmp", "vertical", "told"),
    [
        ({"Camera:VertCS": "ellipsoidal", "drone:AbsoluteAltitude": "+198.309"}, "ellipsoidal", ""),
        ({"Camera:VerticCS": "ellipsoidal", "drone:AbsoluteAltitude": "198.309"}, "ellipsoidal", ""),
        ({"Camera:VertCS": "ellipsoidal"}, "ellipsoidal", ""),
        ({"Camera:VertCS": "EPSG:5773", "drone-dji:RtkFlag": "50"}, "egm96", ""),
        ({"Camera:VertCS": "EGM2008"}, "egm2008", ""),
        ({"CRSInfo:VERTCRS": "EGM96"}, "egm96", ""),
        ({"Camera:VertCS": "EPSG:5703"}, "unknown", "EPSG:5703"),
        ({"drone-skydio:AbsoluteAltitude": "198.309"}, "unknown", "--vertical"),
        ({"drone:AbsoluteAltitude": "198.309"}, "unknown", "--vertical"),
        ({"drone-yuneec:GPSAltitude": "198.309"}, "unknown", "--vertical"),
    ],
)
def test_the_stated_surface_counts_and_a_maker_only_where_it_is_documented(
    xmp: dict[str, str], vertical: str, told: str
) -> None:
    found, warnings = read_fix(Tags(gps=GPS, xmp=xmp))
    assert found is not None
    assert (found.height_m, found.vertical) == (198.309, vertical)
    assert told in " ".join(warnings)
    assert bool(told) == bool(warnings)


@pytest.mark.parametrize("height", [0.0, 1e300, 1e12, -5000.0, math.nan, math.inf])
def test_impossible_heights_are_none(height: float) -> None:
    found, warnings = read_fix(Tags(gps={**GPS, "GPSAltitude": height}))
    assert found is not None
    assert found.height_m is None
    assert any("height" in warning for warning in warnings)
    by_xmp, _ = read_fix(Tags(gps={**GPS, "GPSAltitude": height}, xmp={"drone-dji:AbsoluteAltitude": str(height)}))
    assert by_xmp is not None
    assert by_xmp.height_m is None


def test_rtk_sigmas() -> None:
    def sigmas(**values: str) -> tuple[float | None, float | None]:
        found = fix(xmp={f"drone-dji:RtkStd{name}": value for name, value in values.items()})
        return found.sigma_h_m, found.sigma_v_m

    assert sigmas(Lon="0.012", Lat="0.015", Hgt="0.03") == (0.015, 0.03)
    assert sigmas(Lon="0", Lat="0", Hgt="nan") == (None, None)
    assert sigmas(Lon="1e-300", Lat="1e-300", Hgt="1e300") == (None, None)
    assert sigmas(Lon="-1", Lat="-1", Hgt="-1") == (None, None)


def test_accuracies_may_be_fractions() -> None:
    """Parrot's documentation: one sigma in metres, as a fraction."""
    found = fix(xmp={"Camera:GPSXYAccuracy": "845389/2097152", "Camera:GPSZAccuracy": "5117051/8388608"})
    assert (found.sigma_h_m, found.sigma_v_m) == pytest.approx((0.40311, 0.61000), abs=1e-4)
    assert fix(xmp={"Camera:GPSXYAccuracy": "1/0"}).sigma_h_m is None


@pytest.mark.parametrize(
    ("xmp", "lat_deg", "lon_deg"),
    [
        ({"drone-dji:GpsLatitude": "+47.5", "drone-dji:GpsLongtitude": "-8.25"}, 47.5, -8.25),
        ({"drone:GpsLatitude": "47.5", "drone:GpsLongitude": "-8.25"}, 47.5, -8.25),
        ({"drone-skydio:Latitude": "47.5", "drone-skydio:Longitude": "-8.25"}, 47.5, -8.25),
        ({"exif:GPSLatitude": "47,30.0000000N", "exif:GPSLongitude": "8,15.0W"}, 47.5, -8.25),
        ({"exif:GPSLatitude": "47,30,00S", "exif:GPSLongitude": "8,15,00E"}, -47.5, 8.25),
    ],
)
def test_position_from_xmp_alone(xmp: dict[str, str], lat_deg: float, lon_deg: float) -> None:
    found, _ = read_fix(Tags(xmp={**xmp, "drone-dji:AbsoluteAltitude": "400"}))
    assert found is not None
    assert (found.lat_deg, found.lon_deg, found.height_m) == (lat_deg, lon_deg, 400.0)


@pytest.mark.parametrize(
    ("names", "down"),
    [
        ("drone-dji:Gimbal{}Degree", -90.0),
        ("drone:Gimbal{}Degree", -90.0),
        ("drone-parrot:Camera{}Degree", -90.0),
        ("drone-skydio:CameraOrientationNED/{}", -90.0),
        ("drone-yuneec:Gimbal{}", -90.0),
        ("xmp:Camera{}", -90.0),
        ("Camera:{}", 0.0),
    ],
)
def test_angles_of_makers(names: str, down: float) -> None:
    """A camera that looks down to the north-east, 30 degrees forward of straight down."""
    values = {"Yaw": 45.0, "Pitch": down + 30.0, "Roll": 0.0}
    found, told = read_attitude(Tags(xmp={names.format(name): f"{value:+.2f}" for name, value in values.items()}))
    assert told == ()
    assert found is not None
    assert (found.yaw_deg, found.pitch_deg, found.roll_deg) == pytest.approx((45.0, -60.0, 0.0), abs=1e-6)


def test_a_roll_of_the_aircraft_swings_the_view_aside() -> None:
    """In Pix4D's convention the roll is the aircraft's: 10 degrees to the right look 10 degrees to the left."""
    found = gimbal_of_body(0.0, 0.0, 10.0)
    view = enu_from_cam_rotation(found.yaw_deg, found.pitch_deg, found.roll_deg)[:, 2]
    assert view == pytest.approx([-math.sin(math.radians(10)), 0.0, -math.cos(math.radians(10))], abs=1e-9)


def test_angles_agree_between_the_two_conventions_of_one_photograph() -> None:
    """Parrot documents one photograph in both: its NED angles and Pix4D's are the same view."""
    ned = read_attitude(
        Tags(
            xmp={
                "drone-parrot:CameraYawDegree": "146.848038",
                "drone-parrot:CameraPitchDegree": "-51.988888",
                "drone-parrot:CameraRollDegree": "-0.052789",
            }
        )
    )[0]
    body = read_attitude(
        Tags(xmp={"Camera:Yaw": "146.781036", "Camera:Pitch": "38.011101", "Camera:Roll": "-0.041258"})
    )[0]
    assert ned is not None
    assert body is not None
    views = [enu_from_cam_rotation(a.yaw_deg, a.pitch_deg, a.roll_deg)[:, 2] for a in (ned, body)]
    assert np.degrees(np.arccos(views[0] @ views[1])) < 0.1


@pytest.mark.parametrize("odd", ["nan", "1e300", "-200", "x", ""])
def test_impossible_angles_are_left_out(odd: str) -> None:
    angles = {"Yaw": "+45.00", "Pitch": "-89.90", "Roll": "0"}
    xmp = {f"drone-dji:Gimbal{name}Degree": value for name, value in angles.items()}
    assert read_attitude(Tags(xmp=xmp))[0] == Attitude(45.0, -89.9, 0.0)
    found, told = read_attitude(Tags(xmp={**xmp, "drone-dji:GimbalPitchDegree": odd}))
    assert found is None
    assert told
    assert read_attitude(Tags()) == (None, ())
    zero = dict.fromkeys(xmp, "0")
    assert read_attitude(Tags(xmp=zero))[0] is None


def test_flying_heights() -> None:
    assert read_above_takeoff_m(Tags(xmp={"drone-dji:RelativeAltitude": "+39.80"})) == 39.8
    assert read_above_takeoff_m(Tags(xmp={"Camera:AboveGroundAltitude": "11485529/262144"})) == pytest.approx(
        43.81, abs=0.01
    )
    assert read_above_takeoff_m(Tags(xmp={"drone-dji:RelativeAltitude": "1e12"})) is None


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (IFDRational(0, 0), None), (IFDRational(1, 0), None), (math.inf, None), ("x", None), (None, None), ((3,), 3.0),
        ("3/4", 0.75), ("1/0", None), ("9" * 5000, None), (10**400, None), (True, None),
    ],
)  # fmt: skip
def test_finite(value: Any, number: float | None) -> None:
    assert finite(value) == number
