"""Position files: every allowed form of a line, and what is refused with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.intake.positions_file import read_positions, with_positions
from onthefly3r.records import Attitude, GpsFix, Shot


def file(folder: Path, text: str) -> Path:
    (folder / "geo.txt").write_text(text, encoding="utf-8")
    return folder / "geo.txt"


def shot(name: str) -> Shot:
    return Shot(name, Path(name), 800, 600, "cam", 0.7, 0.05, "guess", gps=GpsFix(1.0, 2.0, 3.0))


def test_every_form_of_a_line(tmp_path: Path) -> None:
    lines = (
        "\ufeff# made by hand",
        "EPSG:4326",
        "a.jpg 15.5 48.2",
        "b.jpg\t15.5\t48.2\t310 # note",
        "c.jpg 15.5 48.2 310 30 0 0",
        "d e.jpg\t15.5\t48.2\t310\t30\t60\t1\t0.02\t0.04",
    )
    text = "\n".join(lines)
    a, b, c, d = read_positions(file(tmp_path, text))
    assert a.gps == GpsFix(48.2, 15.5, None)
    assert b.gps.height_m == 310.0
    assert (c.attitude, c.gps.sigma_h_m) == (Attitude(30.0, -90.0, 0.0), None)
    assert d.attitude == Attitude(30.0, -30.0, 1.0)  # of a gimbal: -90 looks down, 0 to the horizon
    assert (d.name, d.gps.sigma_h_m, d.gps.sigma_v_m) == ("d e.jpg", 0.02, 0.04)


@pytest.mark.parametrize("crs", ["EPSG:32633", "WGS84 UTM 33N", "+proj=utm +zone=33 +datum=WGS84 +units=m"])
def test_projected_positions(tmp_path: Path, crs: str) -> None:
    (position,) = read_positions(file(tmp_path, f"{crs}\na.jpg 500000 0 1\n"))
    assert position.gps.lon_deg == pytest.approx(15.0, abs=1e-9)
    assert position.gps.lat_deg == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:4326\n", "no positions"),
        ("nonsense\na.jpg 1 2\n", "must be a CRS"),
        ("EPSG:4326\na.jpg 1 2\nb.jpg 1 x\n", "line 3: expected"),
        ("EPSG:4326\na.jpg 1 2 3 4\n", "line 2: 4 numbers"),
        ("EPSG:4326\na.jpg 15 120 3\n", "is no place"),
        ("EPSG:4326\na.jpg 15 20\na.jpg 15 20\n", "more than once"),
    ],
)
def test_refused_with_the_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ReferenceFormatError, match=message):
        read_positions(file(tmp_path, text))


def test_shots_take_the_positions_of_the_file_and_lose_their_own(tmp_path: Path) -> None:
    positions = read_positions(file(tmp_path, "EPSG:4326\nA.JPG 15 48 1\nf1/b.jpg 16 48 1\nsame.jpg 17 48 1\n"))
    shots = [shot(name) for name in ("x/a.jpg", "f1/b.jpg", "f2/b.jpg", "f1/same.jpg", "f2/same.jpg")]
    found = with_positions(shots, positions)
    assert [s.gps.lon_deg if s.gps else None for s in found] == [15.0, 16.0, None, None, None]
    with pytest.raises(ReferenceFormatError, match="none of the photographs"):
        with_positions([shot("other.jpg")], positions)
