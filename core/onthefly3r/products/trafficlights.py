"""The verdict of a report: one sentence, and a traffic light for each thing that makes a survey good."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Colour = Literal["green", "amber", "red", "grey"]  # grey: nothing is known of it

GOOD_SHARE, LEAST_SHARE = 0.97, 0.90  # of the photographs that are placed
GOOD_OVERLAP, LEAST_OVERLAP = 5.0, 3.0  # photographs that show a point, median
GOOD_H_M, LEAST_H_M = 1.5, 5.0  # horizontal residuals of positions without RTK
MAX_OUTLIERS = 0.2  # share of the positions
WORDS = {"green": "good", "amber": "to be checked", "red": "bad", "grey": "unknown"}


@dataclass(frozen=True)
class Light:
    """One traffic light."""

    name: str
    colour: Colour
    text: str


def placed_share(report: Mapping[str, Any]) -> float:
    """Return the share of the photographs that are placed, 0 when none were given."""
    images = report["images"]
    return float(images["placed"] / images["given"]) if images["given"] else 0.0


def lights(report: Mapping[str, Any]) -> list[Light]:
    """Return the traffic lights of a report as `report.build_report` makes it."""
    return [_placed(report), _georeference(report), _overlap(report), _layers(report), _colours(report)]


def sentence(report: Mapping[str, Any]) -> str:
    """Return the verdict; a run that placed too few photographs says so first."""
    images, share = report["images"], placed_share(report)
    if report["error"]:
        return f"There is no result: {report['error']}"
    placed = f"{images['placed']} of {images['given']} photographs are placed ({100.0 * share:.0f} %)"
    if share < LEAST_SHARE:
        return f"Part of the survey is missing: only {placed}."
    weak = [light.name.lower() for light in lights(report) if light.colour in ("amber", "red")]
    if not weak:
        return f"The survey is good: {placed}."
    return f"The survey can be used, but check {' and '.join(weak)}: {placed}."


def _placed(report: Mapping[str, Any]) -> Light:
    share = placed_share(report)
    colour: Colour = "green" if share >= GOOD_SHARE else "amber" if share >= LEAST_SHARE else "red"
    return Light("Photographs placed", colour, f"{100.0 * share:.1f} %")


def _georeference(report: Mapping[str, Any]) -> Light:
    geo = report["georeference"]
    if geo is None or geo["rmse_h_m"] is None:
        return Light("Georeferencing", "grey", "local coordinates, not tied to the Earth")
    outliers = geo["n_outliers"] / max(1, geo["n_used"] + geo["n_outliers"])
    told = f"residuals of the positions {geo['rmse_h_m']:.2f} m, {geo['n_outliers']} positions set aside"
    if geo["rmse_h_m"] > LEAST_H_M or outliers > 2.0 * MAX_OUTLIERS:
        return Light("Georeferencing", "red", told)
    good = geo["rmse_h_m"] <= GOOD_H_M and outliers <= MAX_OUTLIERS
    return Light("Georeferencing", "green" if good else "amber", told)


def _overlap(report: Mapping[str, Any]) -> Light:
    ortho = report.get("orthophoto")
    if not ortho:
        return Light("Overlap", "grey", "no orthophoto was made")
    count = ortho["overlap"]
    colour: Colour = "green" if count >= GOOD_OVERLAP else "amber" if count >= LEAST_OVERLAP else "red"
    return Light("Overlap", colour, f"{count:.0f} photographs show a point (median)")


def _layers(report: Mapping[str, Any]) -> Light:
    name = "Internal consistency"
    layers = report["details"].get("dense_cloud", {}).get("layers", {})
    spread = (layers.get("averaged") or layers.get("single") or {}).get("median")
    gsd_m = (report.get("orthophoto") or {}).get("gsd_m")
    if spread is None or not gsd_m:
        return Light(name, "grey", "not measured")
    colour: Colour = "green" if spread <= gsd_m else "amber" if spread <= 3.0 * gsd_m else "red"
    return Light(name, colour, f"heights from single photographs differ by {spread:.3f} m (median in cells of 1 m)")


def _colours(report: Mapping[str, Any]) -> Light:
    ortho = report.get("orthophoto")
    if not ortho:
        return Light("Agreement of the photographs", "grey", "no orthophoto was made")
    left = 100.0 * ortho["colour_difference"]
    colour: Colour = "green" if left < 6.0 else "amber" if left < 15.0 else "red"
    return Light("Agreement of the photographs", colour, f"colours of the same point differ by {left:.1f} % (median)")
