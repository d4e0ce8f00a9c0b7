"""`preview.png`: the cloud from above with the cameras, a scale bar and a north arrow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..files.atomic import replacing
from ..geometry.arrays import Float
from .las import CloudSummary
from .rows import CameraRow
from .topview import TopView, Window, read_points

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont, ImageFont

WIDTH_PX = 1600
MAX_HEIGHT_PX = 1600
BAND_PX = 84  # above the map for the title, below it for the legend
MARGIN = 0.04  # around the window, share of its larger side

BACKGROUND = (24, 26, 30)
TEXT = (235, 237, 240)
MUTED = (150, 155, 163)
PLACED = (45, 212, 235)
REJECTED = (255, 82, 82)


def write_preview(
    path: Path, cloud: CloudSummary, rows: Sequence[CameraRow], title: str, georeferenced: bool, unit: str = "m"
) -> None:
    """Write a PNG about 1600 px wide of a cloud that was written.

    Placed cameras are dots joined in capture order, rejected ones crosses at their tagged position. Points far outside
    the bulk of the cloud and rejected ones farther than its size beyond it may lie outside the picture.

    Args:
        path: final name, ending in .png.
        cloud: of `las.write_cloud`; its file is read in chunks.
        rows: in capture order, in the frame of the cloud.
        title: first line of the picture.
        georeferenced: draws a north arrow.
        unit: of lengths.
    """
    from PIL import Image, ImageDraw

    window = _window(cloud.window, rows)
    scale_px_m = min(WIDTH_PX / window.width, MAX_HEIGHT_PX / window.height)
    # Pixels no finer than the points: an open cloud still gives a closed picture.
    pixel_m = max(1.0 / scale_px_m, cloud.mean_spacing_m if np.isfinite(cloud.mean_spacing_m) else 0.0)
    view = TopView(window, pixel_m)
    for points, rgb in read_points(cloud.path):
        view.add(points, rgb)
    view.close_gaps()

    size = (max(640, round(window.width * scale_px_m)), max(320, round(window.height * scale_px_m)))
    picture = Image.new("RGB", (size[0], size[1] + 2 * BAND_PX), BACKGROUND)
    drawn = (round(window.width * scale_px_m), round(window.height * scale_px_m))
    corner = ((size[0] - drawn[0]) // 2, BAND_PX + (size[1] - drawn[1]) // 2)
    colours = np.where(view.filled[..., None], view.rgb, np.array(BACKGROUND, np.uint8))
    picture.paste(Image.fromarray(colours).resize(drawn, Image.Resampling.LANCZOS), corner)

    draw = ImageDraw.Draw(picture, "RGBA")
    top_left = np.array([window.min_x, window.max_y])
    _draw_cameras(draw, rows, lambda xy: (np.asarray(xy) - top_left) * (scale_px_m, -scale_px_m) + corner)
    _draw_title(draw, picture.width, title, rows, georeferenced)
    _draw_legend(draw, picture.size, rows, scale_px_m, unit)
    with replacing(path) as temporary:
        picture.save(temporary, format="PNG", compress_level=4)


def round_length(longest: float) -> float:
    """Return the greatest of 1, 2, 5 times a power of ten that is not above `longest`."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= longest * (1.0 + 1e-9)))


def _window(cloud: tuple[float, float, float, float], rows: Sequence[CameraRow]) -> Window:
    everything = np.concatenate([np.reshape(cloud, (2, 2)), _positions(rows, "placed")])
    low, high = everything.min(axis=0), everything.max(axis=0)
    # A tag may be wrong by kilometres: rejected ones count up to the window's larger side away.
    rejected, reach = _positions(rows, "rejected"), float((high - low).max())
    near = rejected[((rejected >= low - reach) & (rejected <= high + reach)).all(axis=1)]
    everything = np.concatenate([everything, near])
    low, high = everything.min(axis=0), everything.max(axis=0)
    side = max(float((high - low).max()), 1e-6)
    middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, side / 8.0)  # no slivers
    low, high = middle - half, middle + half
    return Window(float(low[0]), float(low[1]), float(high[0]), float(high[1])).grown(MARGIN * side)


def _positions(rows: Sequence[CameraRow], status: str) -> Float:
    """Return the positions (N, 2) in the plane of the rows that have the status and a position."""
    return np.array([row.position[:2] for row in rows if row.status == status and row.position]).reshape(-1, 2)


def _draw_cameras(draw: ImageDraw, rows: Sequence[CameraRow], to_pixels: Callable[[Float], Float]) -> None:
    placed, rejected = to_pixels(_positions(rows, "placed")), to_pixels(_positions(rows, "rejected"))
    if len(placed) > 1:
        path = [(float(x), float(y)) for x, y in placed]
        draw.line(path, fill=(*BACKGROUND, 120), width=5, joint="curve")
        draw.line(path, fill=(*PLACED, 150), width=2, joint="curve")
    for x, y in placed:
        _dot(draw, float(x), float(y))
    for x, y in rejected:
        _cross(draw, float(x), float(y))


def _dot(draw: ImageDraw, x: float, y: float, radius: float = 5.0) -> None:
    draw.ellipse((x - radius - 2, y - radius - 2, x + radius + 2, y + radius + 2), fill=(*BACKGROUND, 200))
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=PLACED)


def _cross(draw: ImageDraw, x: float, y: float, arm: float = 8.0) -> None:
    for colour, width in ((BACKGROUND, 7), (REJECTED, 4)):
        draw.line((x - arm, y - arm, x + arm, y + arm), fill=colour, width=width)
        draw.line((x - arm, y + arm, x + arm, y - arm), fill=colour, width=width)


def _draw_title(draw: ImageDraw, width: int, title: str, rows: Sequence[CameraRow], georeferenced: bool) -> None:
    middle = BAND_PX // 2
    draw.text((32, middle), title, font=_font(30), fill=TEXT, anchor="lm")
    placed = sum(row.status == "placed" for row in rows)
    right = width - 32
    if georeferenced:  # arrow to grid north, which is up
        tip, foot = middle - 24, middle + 24
        draw.polygon([(right - 14, foot), (right, tip), (right, foot - 11)], fill=TEXT)
        draw.polygon([(right + 14, foot), (right, tip), (right, foot - 11)], fill=MUTED)
        draw.text((right - 24, middle), "N", font=_font(26), fill=TEXT, anchor="rm")
        right -= 72
    draw.text((right, middle), f"{placed} of {len(rows)} images placed", font=_font(24), fill=MUTED, anchor="rm")


def _draw_legend(
    draw: ImageDraw, size: tuple[int, int], rows: Sequence[CameraRow], scale_px_m: float, unit: str
) -> None:
    middle = size[1] - BAND_PX // 2
    length = round_length(size[0] / 4.0 / scale_px_m)
    left, right = 32.0, 32.0 + length * scale_px_m
    for k in range(4):  # quarters, light and dark
        quarter = (right - left) / 4.0
        box = (left + k * quarter, middle - 5, left + (k + 1) * quarter, middle + 5)
        draw.rectangle(box, fill=TEXT if k % 2 == 0 else MUTED)
    draw.text((right + 14, middle), f"{length:g} {unit}", font=_font(24), fill=TEXT, anchor="lm")

    entries: list[tuple[Callable[[ImageDraw, float, float], None], str]] = [(_dot, "camera placed")]
    if any(row.status == "rejected" and row.position for row in rows):
        entries.append((_cross, "rejected, at its tagged position"))
    x = float(size[0] - 32)
    for mark, text in reversed(entries):
        draw.text((x, middle), text, font=_font(22), fill=MUTED, anchor="rm")
        x -= draw.textlength(text, font=_font(22)) + 20.0
        mark(draw, x, float(middle))
        x -= 34.0


def _font(size: int) -> FreeTypeFont | ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size)
