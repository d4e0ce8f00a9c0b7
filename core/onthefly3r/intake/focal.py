"""Focal length prior of one photograph: sensor table, focal plane resolution, 35-mm equivalent, or a guess."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

from .tags import Tags

FILM_DIAGONAL_MM = 43.27  # of the 36 x 24 mm frame that 35-mm equivalents refer to (CIPA DCG-001)
GUESS_RATIO, GUESS_SIGMA = 0.85, 0.30
SENSOR_SIGMA, EQUIVALENT_SIGMA = 0.05, 0.07
# What lenses of drones and hand-held cameras have: tags outside were never measured (65535 stands for "unknown").
LEAST_EQUIVALENT_MM, MOST_EQUIVALENT_MM = 5.0, 2_000.0
LEAST_FOCAL_MM, MOST_FOCAL_MM = 0.5, 1_200.0
MOST_DIGITAL_ZOOM = 50.0
LEAST_RATIO, MOST_RATIO = 0.1, 60.0  # focal length over longest side
WIDE_ASPECT = 1.6  # beyond this a photograph is taken for a crop of a 4:3 sensor that kept its full width


@dataclass(frozen=True)
class FocalPrior:
    """Focal length over longest side, its relative sigma, and where it comes from."""

    ratio: float
    sigma: float
    source: str


def focal_prior(tags: Tags, width_px: int, height_px: int, focal_35mm: float | None = None) -> FocalPrior:
    """Return the best focal prior for an image of this size; a ratio survives any downsizing of the photograph.

    Order: the caller's 35-mm equivalent, sensor table, EXIF focal plane resolution, 35-mm tag, guess.
    """
    longest, shortest = max(width_px, height_px), min(width_px, height_px)
    aspect = longest / shortest
    if focal_35mm is not None:
        return FocalPrior(_equivalent_ratio(focal_35mm, aspect), SENSOR_SIGMA, "option")
    equivalent_mm = tags.number("FocalLengthIn35mmFilm", LEAST_EQUIVALENT_MM, MOST_EQUIVALENT_MM)
    equivalent = _equivalent_ratio(equivalent_mm, aspect) if equivalent_mm else None
    focal_mm = tags.number("FocalLength", LEAST_FOCAL_MM, MOST_FOCAL_MM)
    if focal_mm:
        zoom = tags.number("DigitalZoomRatio", 1.0, MOST_DIGITAL_ZOOM) or 1.0
        sensor = sensor_size_mm(tags.text("Make"), tags.text("Model"))
        ratio = None if sensor is None else focal_mm * zoom / _used_width_mm(sensor, aspect)
        if ratio is not None and LEAST_RATIO <= ratio <= MOST_RATIO:
            return FocalPrior(ratio, SENSOR_SIGMA, "exif+sensor")
        ratio = _focal_plane_ratio(tags, focal_mm)
        # The resolution tag counts original pixels; where ExifImageWidth was rewritten by a resize it misleads.
        if ratio is not None and (equivalent is None or abs(ratio / equivalent - 1.0) < 0.2):
            return FocalPrior(ratio * zoom, SENSOR_SIGMA, "exif+focal plane")
    if equivalent is not None:
        return FocalPrior(equivalent, EQUIVALENT_SIGMA, "exif 35 mm")
    return FocalPrior(GUESS_RATIO, GUESS_SIGMA, "guess")


def sensor_size_mm(make: str, model: str) -> tuple[float, float] | None:
    """Return (width, height) of a camera's sensor from the table, None when it is not listed."""
    return _sensor_table().get((_key(make), _key(model))) or _sensor_table().get(("", _key(model)))


@lru_cache(maxsize=1)
def _sensor_table() -> dict[tuple[str, str], tuple[float, float]]:
    table: dict[tuple[str, str], tuple[float, float]] = {}
    text = (files(__package__) / "sensors.csv").read_text("utf-8")
    for row in csv.DictReader(text.splitlines()):
        size = float(row["width_mm"]), float(row["height_mm"])
        table[_key(row["make"]), _key(row["model"])] = size
        table[("", _key(row["model"]))] = size  # some programs drop or rewrite the maker
    return table


def _key(text: str) -> str:
    return "".join(c for c in text.lower() if c.isalnum())


def _used_width_mm(sensor_mm: tuple[float, float], aspect: float) -> float:
    """Return the sensor length behind the image's longest side: crops keep the width or the height."""
    width, height = max(sensor_mm), min(sensor_mm)
    return width if aspect >= width / height * 0.99 else height * aspect


def _equivalent_ratio(equivalent_mm: float, aspect: float) -> float:
    """Return focal / longest side of a 35-mm equivalent by the diagonal rule, on the uncropped sensor."""
    native = 4.0 / 3.0 if aspect > WIDE_ASPECT else aspect
    return equivalent_mm / FILM_DIAGONAL_MM * float((1.0 + native**-2) ** 0.5)


def _focal_plane_ratio(tags: Tags, focal_mm: float) -> float | None:
    resolution = tags.number("FocalPlaneXResolution", 1e-3, 1e8)
    unit_mm = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 0.001}.get(tags.number("FocalPlaneResolutionUnit") or 2.0, 25.4)
    width = max(tags.number("ExifImageWidth", 1.0, 1e6) or 0.0, tags.number("ExifImageHeight", 1.0, 1e6) or 0.0)
    if not resolution or not width:
        return None
    sensor_mm = width / resolution * unit_mm
    ratio = focal_mm / sensor_mm if 3.5 <= sensor_mm <= 60.0 else 0.0
    return ratio if LEAST_RATIO <= ratio <= MOST_RATIO else None
