from __future__ import annotations

import math
from typing import Any

import pytest
from PIL.TiffImagePlugin import IFDRational

from onthefly3r.intake.position import read_attitude, read_fix
from onthefly3r.intake.tags import MAX_XMP_BYTES, Tags, finite, parse_xmp
from onthefly3r.records import Attitude, GpsFix

GPS = {
    "GPSLatitudeRef": "N",
    "GPSLatitude": (46.0, 50.0, 33.3855),
    "GPSLongitudeRef": "W",
    "GPSLongitude": (91.0, 59.0, 40.4156),
    "GPSAltitudeRef": b"\x00",
    "GPSAltitude": 198.309,
}


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


@pytest.mark.parametrize(
    "gps",
    [
        {},
        {"GPSLatitude": (0.0, 0.0, 0.0), "GPSLongitude": (0.0, 0.0, 0.0)},
        {"GPSLatitude": (IFDRational(0, 0),) * 3, "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (math.nan, 0.0, 0.0), "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (95.0, 0.0, 0.0), "GPSLongitude": (8.0, 0.0, 0.0)},
        {"GPSLatitude": (), "GPSLongitude": "east"},
        {"GPSLatitude": (47.0, 0.0, 0.0)},
    ],
    ids=["nothing", "null island", "0/0", "nan", "off the Earth", "text", "half"],
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
    ],
)
def test_dji_altitude_reference(xmp: dict[str, str], vertical: str, rtk: int | None) -> None:
    found = fix(xmp={"AbsoluteAltitude": "+521.30", **xmp})
    assert (found.height_m, found.vertical, found.rtk) == (521.3, vertical, rtk)


def test_rtk_sigmas() -> None:
    found = fix(xmp={"RtkStdLon": "0.012", "RtkStdLat": "0.015", "RtkStdHgt": "0.03"})
    assert (found.sigma_h_m, found.sigma_v_m) == (0.015, 0.03)
    zero = fix(xmp={"RtkStdLon": "0", "RtkStdLat": "0", "RtkStdHgt": "nan"})
    assert (zero.sigma_h_m, zero.sigma_v_m) == (None, None)


def test_position_from_xmp_alone() -> None:
    found, _ = read_fix(Tags(xmp={"GpsLatitude": "+47.5", "GpsLongtitude": "-8.25", "AbsoluteAltitude": "400"}))
    assert found is not None
    assert (found.lat_deg, found.lon_deg, found.height_m) == (47.5, -8.25, 400.0)


def test_gimbal_angles() -> None:
    angles = {"GimbalYawDegree": "+45.00", "GimbalPitchDegree": "-89.90", "GimbalRollDegree": "0"}
    assert read_attitude(Tags(xmp=angles)) == Attitude(45.0, -89.9, 0.0)
    assert read_attitude(Tags(xmp={**angles, "GimbalRollDegree": "nan"})) is None
    assert read_attitude(Tags()) is None


def packet(inside: str, attributes: str = "") -> bytes:
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        f'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:d="http://www.dji.com/drone-dji/1.0/" {attributes}>'
        f'{inside}</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>  \n\0'
    ).encode()


@pytest.mark.parametrize(
    "data",
    [
        packet("", 'drone-dji:GimbalYawDegree="+30.10"'),
        packet("", 'd:GimbalYawDegree="+30.10"'),
        packet("<drone-dji:GimbalYawDegree>+30.10</drone-dji:GimbalYawDegree>"),
        packet("<d:GimbalYawDegree> +30.10\n</d:GimbalYawDegree>"),
    ],
    ids=["attribute", "attribute, other prefix", "element", "element, other prefix"],
)
def test_xmp_forms(data: bytes) -> None:
    assert Tags(xmp=parse_xmp(data)).xmp_number("GimbalYawDegree") == 30.1


@pytest.mark.parametrize(
    "data",
    [
        b"<a><b></a>",
        b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>',
        b"<a" + b" " * MAX_XMP_BYTES + b"/>",
        b"\xff\xfe\x00garbage",
    ],
    ids=["broken", "entity", "too large", "binary"],
)
def test_bad_xmp_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        parse_xmp(data)


@pytest.mark.parametrize(
    ("value", "number"),
    [(IFDRational(0, 0), None), (IFDRational(1, 0), None), (math.inf, None), ("x", None), (None, None), ((3,), 3.0)],
)
def test_finite(value: Any, number: float | None) -> None:
    assert finite(value) == number
