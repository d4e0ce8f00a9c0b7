"""Position files: every allowed form of a line, what is told about it, and what is refused with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.geometry.geoid import egm96_undulation_m
from onthefly3r.intake.positions_file import FilePosition, read_positions, with_positions
from onthefly3r.records import Attitude, GpsFix, Shot

FOOT_US, FOOT = 1200.0 / 3937.0, 0.3048


def file(folder: Path, text: str | bytes) -> Path:
    data = text.encode() if isinstance(text, str) else text
    (folder / "geo.txt").write_bytes(data)
    return folder / "geo.txt"


def positions(folder: Path, text: str | bytes) -> tuple[FilePosition, ...]:
    return read_positions(file(folder, text)).positions


def told(folder: Path, text: str) -> str:
    return " ".join(read_positions(file(folder, text)).warnings)


def shot(name: str, lat: float = 1.0, lon: float = 2.0, height: float | None = 3.0) -> Shot:
    return Shot(name, Path(name), 800, 600, "cam", 0.7, 0.05, "guess", gps=GpsFix(lat, lon, height))


def test_every_form_of_a_line(tmp_path: Path) -> None:
    lines = (
        "\ufeff# made by hand",
        "EPSG:4326",
        "a.jpg 15.5 48.2",
        "b.jpg\t15.5\t48.2\t310 # note",
        "c.jpg 15.5 48.2 310 30 0 0",
        "d e.jpg\t15.5\t48.2\t310\t30\t60\t0\t0.02\t0.04",
    )
    a, b, c, d = positions(tmp_path, "\n".join(lines))
    assert a.gps == GpsFix(48.2, 15.5, None)
    assert b.gps.height_m == 310.0
    assert c.gps.sigma_h_m is None
    for found, expected in ((c, Attitude(30.0, -90.0, 0.0)), (d, Attitude(30.0, -30.0, 0.0))):
        assert found.attitude is not None
        angles = found.attitude.yaw_deg, found.attitude.pitch_deg, found.attitude.roll_deg
        assert angles == pytest.approx((expected.yaw_deg, expected.pitch_deg, expected.roll_deg), abs=1e-4)
    assert (d.name, d.gps.sigma_h_m, d.gps.sigma_v_m) == ("d e.jpg", 0.02, 0.04)


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:4326\nDJI 1 (2).JPG 15.5 48.2 310.25\n",
        "EPSG:4326\nDJI 1 (2).JPG,15.5,48.2,310.25\n",
        "EPSG:4326,,,\r\nDJI 1 (2).JPG,15.5,48.2,310.25,,\r\n",
        'EPSG:4326\n"DJI 1 (2).JPG";15.5;48.2;310.25\n',
        "EPSG:4326\nDJI 1 (2).JPG; 15,5; 48,2; 310,25\n",
        "EPSG:4326\nDJI 1 (2).JPG\t15,5\t48,2\t310,25\n",
        "EPSG:4326\nDJI 1 (2).JPG\t15.5 48.2 310.25\n",
        "EPSG:4326\nDJI 1 (2).JPG 15.5\t48.2  310.25 fixed rtk\n",
        "EPSG:4326\nDJI 1 (2).JPG 15,5 48,2 310,25\n",
        "EPSG:4326\nDJI 1 (2).JPG, 15.5, 48.2, 310.25\n",
        "EPSG:4326\nname,longitude,latitude,altitude\nDJI 1 (2).JPG,15.5,48.2,310.25\n",
        "WGS84\rDJI 1 (2).JPG 15.5 48.2 310.25\r",
        "\ufeffEPSG:4326\nDJI 1 (2).JPG 15.5 48.2 310.25\n".encode("utf-16"),
        "EPSG:4326\n# Stra\xdfe\nDJI 1 (2).JPG 15.5 48.2 310.25\n".encode("cp1252"),
    ],
)
def test_separators_decimal_signs_and_encodings(tmp_path: Path, text: str | bytes) -> None:
    (found,) = positions(tmp_path, text)
    assert found.name == "DJI 1 (2).JPG"
    assert found.gps == GpsFix(48.2, 15.5, 310.25)


@pytest.mark.parametrize("crs", ["EPSG:32633", "WGS84 UTM 33N", "+proj=utm +zone=33 +datum=WGS84 +units=m"])
def test_projected_positions(tmp_path: Path, crs: str) -> None:
    (position,) = positions(tmp_path, f"{crs}\na.jpg 500000 0 1\n")
    assert position.gps.lon_deg == pytest.approx(15.0, abs=1e-9)
    assert position.gps.lat_deg == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("crs", "x", "y", "unit_m", "vertical"),
    [
        ("EPSG:26849+6360", 2901317.688, 455027.991, FOOT_US, "unknown"),
        ("EPSG:26849", 2901317.688, 455027.991, FOOT_US, "unknown"),
        ("EPSG:26849+5773", 2901317.688, 455027.991, 1.0, "egm96"),
        ("EPSG:4326+8228", -91.99456, 46.842607, FOOT, "unknown"),  # NAVD88 in international feet
        ("EPSG:32615+5773", 576663.1, 5188265.0, 1.0, "egm96"),
        ("EPSG:32615+3855", 576663.1, 5188265.0, 1.0, "egm2008"),
        ("EPSG:4326", -91.99456, 46.842607, 1.0, "unknown"),
        ("EPSG:4979", -91.99456, 46.842607, 1.0, "ellipsoidal"),
    ],
)
def test_units_and_vertical_part_of_the_crs_count(
    tmp_path: Path, crs: str, x: float, y: float, unit_m: float, vertical: str
) -> None:
    text = f"{crs}\na.jpg {x} {y} {198.31 / unit_m}\n"
    (position,) = positions(tmp_path, text)
    assert position.gps.height_m == pytest.approx(198.31, abs=1e-6)
    assert position.gps.vertical == vertical
    assert position.gps.lat_deg == pytest.approx(46.8426, abs=2e-3)
    if crs in ("EPSG:26849+6360", "EPSG:4326+8228"):
        assert "NAVD88" in told(tmp_path, text)
    if crs == "EPSG:26849":
        assert "US survey foot" in told(tmp_path, text)


def test_three_dimensional_crs_are_transformed_whole(tmp_path: Path) -> None:
    (position,) = positions(tmp_path, "EPSG:4978\na.jpg 4105000 1138500 4733000\n")
    assert position.gps.vertical == "ellipsoidal"
    (height,) = [position.gps.height_m]
    assert height is not None
    from pyproj import Transformer

    lat, lon, expected = Transformer.from_crs("EPSG:4978", "EPSG:4979").transform(4105000, 1138500, 4733000)
    assert (position.gps.lat_deg, position.gps.lon_deg, height) == pytest.approx((lat, lon, expected), abs=1e-6)


def test_accuracy_of_the_datum_shift_is_told(tmp_path: Path) -> None:
    assert "accuracy of the datum shift" in told(tmp_path, "EPSG:26715\na.jpg 500000 5000000 1\n")
    assert not told(tmp_path, "EPSG:32615\na.jpg 500000 5000000 1\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:4326\n", "no positions"),
        ("nonsense\na.jpg 1 2\n", "must be a CRS"),
        ("EPSG:4326\na.jpg 1 2\nb.jpg 1 x\n", "line 3: expected"),
        ("EPSG:4326\na.jpg 1 2 3 4\n", "line 2: 4 numbers"),
        ("EPSG:4326\na.jpg 15 120 3\n", "is no place"),
        ("EPSG:4326\na.jpg 15 20\na.jpg 15 20\n", "more than once"),
        ("EPSG:4326\na.jpg 15 20 inf\n", "line 2: an infinite"),
        ("EPSG:4326\n\n#x\na.jpg nan 20 3\n", "line 4: x or y is nan"),
        ("EPSG:4326\na.jpg 15 20 1e9\n", "line 2: a height"),
        ("EPSG:4326\na.jpg 15 20 300 400 0 0\n", "line 2: angles"),
        ("EPSG:4326\nname;latitude;longitude\na.jpg;20;15\n", "line 2: latitude or northing comes before"),
        ("+proj=utm +zone=15 +ellps=intl +units=m +no_defs\na.jpg 576663 5188164 198\n", "ballpark"),
    ],
)
def test_refused_with_the_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ReferenceFormatError, match=message):
        read_positions(file(tmp_path, text))


def test_what_is_not_known_may_be_nan_or_negative(tmp_path: Path) -> None:
    text = (
        "EPSG:4326\na.jpg 15 20 nan nan nan nan 0.03 0.05\nb.jpg 15 21 310 1 2 3 -1 0\nc.jpg 15 22 1 1 2 3 1e-300 1e9\n"
    )
    a, b, c = positions(tmp_path, text)
    assert (a.attitude, a.gps.height_m, a.gps.sigma_h_m, a.gps.sigma_v_m) == (None, None, 0.03, 0.05)
    assert (b.gps.sigma_h_m, b.gps.sigma_v_m) == (None, None)
    assert (c.gps.sigma_h_m, c.gps.sigma_v_m) == (None, None)
    assert "accuracy of 1e-300" in told(tmp_path, text)


def test_heights_that_are_all_zero_are_none(tmp_path: Path) -> None:
    text = "EPSG:4326\na.jpg 15 20 0\nb.jpg 15 21 0\n"
    assert [p.gps.height_m for p in positions(tmp_path, text)] == [None, None]
    assert "all heights are 0" in told(tmp_path, text)


def test_angles_of_a_gimbal_are_noticed(tmp_path: Path) -> None:
    text = "EPSG:4326\na.jpg 15 20 300 45 -90 0\nb.jpg 15 21 300 45 -89.9 0\n"
    assert [p.attitude for p in positions(tmp_path, text)] == [None, None]
    assert "look backwards" in told(tmp_path, text)
    assert "all angles are 0" in told(tmp_path, "EPSG:4326\na.jpg 15 20 300 0 0 0\n")


def test_shots_take_the_positions_of_the_file_and_lose_their_own(tmp_path: Path) -> None:
    path = file(tmp_path, "EPSG:4326\nA.JPG 15 48 1\nf1/b.jpg 16 48 1\nsame.jpg 17 48 1\n")
    shots = [shot(name) for name in ("x/a.jpg", "f1/b.jpg", "f2/b.jpg", "f1/same.jpg", "f2/same.jpg")]
    found, warnings = with_positions(shots, read_positions(path))
    assert [s.gps.lon_deg if s.gps else None for s in found] == [15.0, 16.0, None, None, None]
    text = " ".join(warnings)
    assert "3 of 5 photographs are not in the position file, such as f2/b.jpg" in text
    assert "3 of these share their file name" in text
    assert "1 lines of the position file name no photograph, such as same.jpg" in text
    with pytest.raises(ReferenceFormatError, match="none of the photographs"):
        with_positions([shot("other.jpg")], read_positions(path))


def test_positions_are_compared_with_those_in_the_tags(tmp_path: Path) -> None:
    def warnings(text: str, *, height: float | None = 300.0) -> str:
        shots = [shot("a.jpg", 48.2, 15.5, height), shot("b.jpg", 48.201, 15.5, height)]
        return " ".join(with_positions(shots, read_positions(file(tmp_path, text)))[1])

    assert not warnings("EPSG:4326\na.jpg 15.5 48.2 301\nb.jpg 15.5 48.20102 303\n")
    assert "km from those in the tags" in warnings("EPSG:4326\na.jpg 19.5 48.2 301\nb.jpg 19.5 48.201 303\n")
    assert "exchanged" in warnings("EPSG:4326\na.jpg 48.2 15.5 301\nb.jpg 48.201 15.5 303\n")
    assert "in feet?" in warnings("EPSG:4326\na.jpg 15.5 48.2 984\nb.jpg 15.5 48.201 985\n")
    assert not warnings("EPSG:4326\na.jpg 15.5 48.2 984\nb.jpg 15.5 48.201 985\n", height=None)
    undulation = float(egm96_undulation_m(np.array(48.2), np.array(15.5)))
    assert undulation > 40.0
    assert not warnings(f"EPSG:4979\na.jpg 15.5 48.2 {300 + undulation}\nb.jpg 15.5 48.201 {300 + undulation}\n")
