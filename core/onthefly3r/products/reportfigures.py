"""Pictures of the report, drawn into the page itself: maps, residuals, calibration, rejected photographs."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PhotographError
from ..geometry.arrays import Float, UInt8
from ..intake.images import load_working_image
from .rows import CameraRow
from .runview import RunView

MAP_PX = 900  # longer side of the maps
THUMBNAIL_PX = 160
MAX_THUMBNAILS = 60
FLIGHT_GAP_S = 600.0  # a longer pause between photographs begins another flight
RAMP = np.array([[165, 0, 38], [253, 174, 97], [255, 255, 191], [166, 217, 106], [0, 104, 55]], float)


@dataclass(frozen=True)
class Figure:
    """A part of the page: its heading and its HTML, in which everything foreign is escaped."""

    heading: str
    html: str
    note: str = ""


def figures(view: RunView, folder: Path) -> list[Figure]:
    """Return the figures of a run from its view and from the products in `folder`; what is missing is left out."""
    found = [_camera_map(view, folder)]
    for name, heading, note in (
        ("overlap", "Overlap", "How many photographs show each place. Red: fewer than 3, green: 8 and more."),
        ("confidence", "Confidence", "How sure the surface is. Red: 0, green: 1."),
    ):
        path = folder / f"{name}.tif"
        if path.is_file():
            low, high = (1.0, 8.0) if name == "overlap" else (0.0, 1.0)
            found.append(Figure(heading, _picture(_ramped(path, low, high), heading), note))
    found += [_histograms(view.rows, view.unit), _flights(view), _calibration(view), _rejected(view)]
    return [figure for figure in found if figure is not None]


def _camera_map(view: RunView, folder: Path) -> Figure | None:
    rows = [row for row in view.rows if row.position is not None]
    if not rows:
        return None
    positions = np.array([row.position[:2] for row in rows if row.position is not None])
    low, high = positions.min(axis=0), positions.max(axis=0)
    backdrop, path = "", folder / "orthophoto.tif"
    if path.is_file():
        picture, bounds = _reduced(path)
        low, high = np.minimum(low, bounds[:2]), np.maximum(high, bounds[2:])
    side = max(float((high - low).max()), 1e-6)
    low, high, scale = low - 0.03 * side, high + 0.03 * side, MAP_PX / (1.06 * side)
    width, height = (high - low) * scale
    if path.is_file():
        x, y = (bounds[0] - low[0]) * scale, (high[1] - bounds[3]) * scale
        size = (bounds[2:] - bounds[:2]) * scale
        backdrop = (
            f'<image x="{x:.1f}" y="{y:.1f}" width="{size[0]:.1f}" height="{size[1]:.1f}" '
            f'href="{_data_uri(picture, "PNG")}"/>'
        )
    marks = []
    used = [row.d_h for row in rows if row.status == "placed" and row.d_h is not None]
    stretch = 0.08 * MAP_PX / max([*used, 1e-6])
    for row, (east, north) in zip(rows, positions, strict=True):
        x, y = (east - low[0]) * scale, (high[1] - north) * scale
        name = escape(row.image)
        if row.status == "placed":
            if row.dx is not None and row.dy is not None:
                marks.append(
                    f'<path d="M{x:.1f} {y:.1f}l{row.dx * stretch:.1f} {-row.dy * stretch:.1f}" class="arrow"/>'
                )
            marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" class="placed"><title>{name}</title></circle>')
        else:
            title = f"<title>{name}: {escape(row.reason)}</title>"
            marks.append(f'<path d="M{x - 5:.1f} {y - 5:.1f}l10 10m0 -10l-10 10" class="rejected">{title}</path>')
    svg = f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img">{backdrop}{"".join(marks)}</svg>'
    note = "Dots: placed photographs; crosses: rejected ones, where their tags put them."
    if used:
        note += (
            f" Yellow lines: from the camera towards its tagged position, the longest is {max(used):.2f} {view.unit}."
        )
    return Figure("Cameras", svg, note)


def _histograms(rows: Sequence[CameraRow], unit: str) -> Figure | None:
    parts = []
    for axis, label in (("dx", "east"), ("dy", "north"), ("dz", "up")):
        values = np.array([value for row in rows if (value := getattr(row, axis)) is not None], float)
        if len(values) < 3:
            continue
        reach = max(float(np.abs(values).max()), 1e-6)
        counts, _ = np.histogram(values, bins=21, range=(-reach, reach))
        bars = "".join(
            f'<rect x="{12 * k}" y="{100 - 100 * count / counts.max():.1f}" width="11" '
            f'height="{100 * count / counts.max():.1f}" class="bar"/>'
            for k, count in enumerate(counts)
        )
        text = f"{label}: mean {values.mean():.3f}, standard deviation {values.std():.3f} {escape(unit)}"
        parts.append(
            f'<figure><svg viewBox="0 0 252 102" class="small">{bars}</svg>'
            f"<figcaption>{text}<br>from {-reach:.2f} to {reach:.2f}</figcaption></figure>"
        )
    if not parts:
        return None
    note = "Camera minus tagged position. They say how well positions and map fit, not how accurate the map is."
    return Figure("Residuals of the positions", f'<div class="row">{"".join(parts)}</div>', note)


def _flights(view: RunView) -> Figure | None:
    by_number = {row.number - 1: row for row in view.rows if row.status == "placed" and row.dx is not None}
    shots = sorted((view.shots[i].time_s or 0.0, view.shots[i].camera_key, i) for i in by_number)
    flights: list[list[int]] = []
    last: tuple[float, str] | None = None
    for time_s, key, index in shots:
        if last is None or time_s - last[0] > FLIGHT_GAP_S or key != last[1]:
            flights.append([])
        flights[-1].append(index)
        last = time_s, key
    if not flights:
        return None
    lines = []
    for number, members in enumerate(flights, start=1):
        shift = np.array([[by_number[i].dx, by_number[i].dy, by_number[i].dz or 0.0] for i in members]).mean(axis=0)
        lines.append(
            f"<tr><td>{number}</td><td>{escape(by_number[members[0]].t_utc)}</td><td>{len(members)}</td>"
            + "".join(f"<td>{value:+.3f}</td>" for value in shift)
            + "</tr>"
        )
    head = (
        f"<tr><th>flight</th><th>from</th><th>photographs</th><th>east</th><th>north</th><th>up [{view.unit}]</th></tr>"
    )
    return Figure("Bias of each flight", f"<table>{head}{''.join(lines)}</table>")


def _calibration(view: RunView) -> Figure | None:
    lines = []
    for key, camera in sorted(view.state.calibrations.items()):
        shot = next((shot for shot in view.shots.values() if shot.camera_key == key), None)
        prior = shot.focal_ratio * max(shot.width_px, shot.height_px) if shot else float("nan")
        cells = [escape(key), f"{camera.fx:.1f}", f"{prior:.1f}", f"{camera.cx - camera.width / 2:+.1f}"]
        cells += [f"{camera.cy - camera.height / 2:+.1f}", *(f"{k:+.5f}" for k in camera.distortion)]
        lines.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    if not lines:
        return None
    names = ("camera", "focal length [px]", "from the tags [px]", "principal point x", "y", "k1", "k2", "p1", "p2")
    head = "".join(f"<th>{name}</th>" for name in names)
    return Figure("Calibration", f"<table><tr>{head}</tr>{''.join(lines)}</table>")


def _rejected(view: RunView) -> Figure | None:
    boxes = []
    for index, rejection in sorted(view.rejections.items())[:MAX_THUMBNAILS]:
        shot = view.shots[index]
        try:
            image = _data_uri(load_working_image(shot, THUMBNAIL_PX).rgb, "JPEG")
        except (PhotographError, OSError):
            continue
        text = f"{escape(shot.name)}<br>{escape(rejection.reason)}"
        boxes.append(f'<figure><img src="{image}" alt=""><figcaption>{text}</figcaption></figure>')
    return Figure("Pictures of the rejected photographs", f'<div class="row">{"".join(boxes)}</div>') if boxes else None


def _reduced(path: Path) -> tuple[UInt8, Float]:
    """Return an orthophoto (H, W, 4) at the size of the maps, and its bounds west, south, east, north."""
    import rasterio

    with rasterio.open(path) as dataset:
        step = max(dataset.width, dataset.height) / MAP_PX
        shape = max(1, int(dataset.height / step)), max(1, int(dataset.width / step))
        return dataset.read(out_shape=(4, *shape)).transpose(1, 2, 0), np.array(dataset.bounds)


def _ramped(path: Path, low: float, high: float) -> UInt8:
    """Return a raster (H, W, 4) in colours from red to green."""
    import rasterio

    with rasterio.open(path) as dataset:
        step = max(1.0, max(dataset.width, dataset.height) / (MAP_PX / 2))
        shape = max(1, int(dataset.height / step)), max(1, int(dataset.width / step))
        values = dataset.read(1, out_shape=shape).astype(float)
        known = values != dataset.nodata
    place = np.clip((values - low) / (high - low), 0.0, 1.0) * (len(RAMP) - 1)
    colours = np.stack([np.interp(place, np.arange(len(RAMP)), RAMP[:, k]) for k in range(3)], axis=-1)
    return np.dstack([colours, np.where(known, 255, 0)]).astype(np.uint8)


def _picture(pixels: UInt8, alt: str) -> str:
    return f'<img src="{_data_uri(pixels, "PNG")}" alt="{escape(alt)}">'


def _data_uri(pixels: UInt8, kind: str) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def facts_of(made: Mapping[str, Any]) -> dict[str, Any]:
    """Return what products tell the report: figures of the orthophoto and of the surface model."""
    ortho, surface = made.get("orthophoto"), made.get("surface")
    return {
        "orthophoto": None
        if ortho is None
        else {
            "path": ortho.path.name,
            "pixel_m": ortho.pixel_m,
            "gsd_m": ortho.gsd_m,
            "overlap": ortho.overlap,
            "colour_difference_before": ortho.colour_difference_before,
            "colour_difference": ortho.colour_difference,
            "unreadable": list(ortho.missing),
        },
        "surface": None
        if surface is None
        else {"pixel_m": surface.grid.pixel_m, "area_m2": surface.coverage_m2, "files": sorted(surface.paths)},
    }
