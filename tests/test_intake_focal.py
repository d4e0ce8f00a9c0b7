from __future__ import annotations

from typing import Any

import pytest

from onthefly3r.intake.focal import FILM_DIAGONAL_MM, focal_prior, sensor_size_mm
from onthefly3r.intake.tags import Tags

PHANTOM = {"Make": "DJI\0\0\0", "Model": "FC300S\0\0", "FocalLength": 3.61, "FocalLengthIn35mmFilm": 20}
REBEL = {
    "Make": "Acme",
    "Model": "Unlisted",
    "FocalLength": 30.0,
    "ExifImageWidth": 4272,
    "FocalPlaneXResolution": 4865.6036,
    "FocalPlaneResolutionUnit": 2,
}


def prior(exif: dict[str, Any], width: int = 4000, height: int = 3000, **option: float) -> tuple[float, str]:
    found = focal_prior(Tags(exif=exif), width, height, **option)
    return found.ratio, found.source


def test_sensor_table_survives_downsizing_cropping_and_turning() -> None:
    expected = pytest.approx(3.61 / 6.17, rel=1e-9)
    for width, height in ((4000, 3000), (800, 600), (1600, 900), (3000, 4000)):
        assert prior(PHANTOM, width, height) == (expected, "exif+sensor")


def test_a_crop_that_keeps_the_height_uses_less_of_the_sensor() -> None:
    pro = {"Make": "DJI", "Model": "FC6310", "FocalLength": 8.8}
    assert prior(pro, 5472, 3648)[0] == pytest.approx(8.8 / 13.2)
    assert prior(pro, 4864, 3648)[0] == pytest.approx(8.8 / (8.8 * 4864 / 3648))
    assert prior(pro, 5472, 3078)[0] == pytest.approx(8.8 / 13.2)


def test_focal_plane_resolution_counts_original_pixels() -> None:
    ratio, source = prior(REBEL, 1600, 1067)
    assert source == "exif+focal plane"
    assert ratio == pytest.approx(30.0 / (4272 / 4865.6036 * 25.4))
    centimetres = {**REBEL, "FocalPlaneXResolution": 4865.6036 / 2.54, "FocalPlaneResolutionUnit": 3}
    assert prior(centimetres, 1600, 1067)[0] == pytest.approx(ratio)


def test_a_rewritten_original_size_is_not_believed() -> None:
    equivalent = 30.0 * 36.0 / 22.2
    rewritten = {**REBEL, "ExifImageWidth": 1600, "FocalLengthIn35mmFilm": equivalent}
    ratio, source = prior(rewritten, 1600, 1067)
    assert source == "exif 35 mm"
    assert ratio == pytest.approx(1.351, rel=0.02)
    assert prior({**REBEL, "ExifImageWidth": 500}, 500, 333)[1] == "guess"


def test_equivalent_by_the_diagonal() -> None:
    assert prior({"FocalLengthIn35mmFilm": FILM_DIAGONAL_MM})[0] == pytest.approx(5000 / 4000)
    assert prior({"FocalLengthIn35mmFilm": FILM_DIAGONAL_MM}, 4000, 2250)[0] == pytest.approx(1.25)  # crop of 4:3
    assert prior({"FocalLengthIn35mmFilm": 50}, 6000, 4000)[0] == pytest.approx(50 / 36, rel=1e-3)


def test_option_wins_and_a_guess_is_marked() -> None:
    assert prior(PHANTOM, focal_35mm=28.0)[1] == "option"
    guess = focal_prior(Tags(), 4000, 3000)
    assert (guess.ratio, guess.sigma, guess.source) == (0.85, 0.30, "guess")


@pytest.mark.parametrize("value", [0, -3, "x", float("nan"), None])
def test_nonsense_focal_lengths_are_a_guess(value: Any) -> None:
    assert prior({**PHANTOM, "FocalLength": value, "FocalLengthIn35mmFilm": value})[1] == "guess"


def test_sensor_table_is_sane() -> None:
    assert sensor_size_mm("dji", "fc300s") == (6.17, 4.63)
    assert sensor_size_mm("", "ZenmuseP1") == (35.9, 24.0)
    assert sensor_size_mm("DJI", "") is None
    assert sensor_size_mm("Nobody", "Nothing") is None


def test_digital_zoom_lengthens_the_focal_length() -> None:
    plain = prior(PHANTOM)[0]
    assert prior({**PHANTOM, "DigitalZoomRatio": 2.0})[0] == pytest.approx(2.0 * plain)
    assert prior({**PHANTOM, "DigitalZoomRatio": 0.0})[0] == plain  # EXIF: 0 means that no zoom was used
