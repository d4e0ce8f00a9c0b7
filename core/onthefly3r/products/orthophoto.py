"""The orthophoto: photographs laid on the surface model, each where it looks down best and nothing stands between."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PhotographError
from ..geometry.arrays import Bool, Float, UInt8
from ..geometry.camera import PixelMap
from ..intake.images import load_working_image
from ..records import Shot
from .cog import CogWriter, Grid
from .harmonise import ColourSamples, gains, joined, sharpness_lack, spread
from .heightmodels import NODATA, SurfaceRasters, closed
from .runview import RunView
from .terrain import interpolated
from .viewplan import Plan, View, plan_window, views_near

WINDOW_PX = 1024  # of the orthophoto
PLAN_RATIO = 4  # pixels of the orthophoto for each pixel of the plan, at least
FAST_RATIO = 4.0  # the fast orthophoto is so many times coarser than the photographs
OCCLUDER_M = 40.0  # around a window, what may stand in the way is looked for so far
MAX_MARGIN_PX = 96
MAX_CACHE_BYTES = 600 * 2**20  # decoded photographs
BROAD_PX = 24  # photographs are this much coarser for the broad colours
SAMPLE_PX = 512  # photographs are this large for the comparison of colours
SAMPLES = 400  # surface points compared per photograph
BRIDGED = 0.2  # gaps of the surface are bridged for the picture up to this share of the flying height from their edge
COARSE_PX = 1500  # longer side of the surface that bridges them
BORDER_M = 1e-6


@dataclass(frozen=True)
class OrthoSummary:
    """What was made, and how well the photographs agree in colour."""

    path: Path
    pixel_m: float
    width: int
    height: int
    covered_share: float  # of the surface model that a photograph shows
    colour_difference_before: float  # median relative difference of a photograph from the mean of its points
    colour_difference: float  # the same with the gains
    gsd_m: float  # median of the photographs
    overlap: float  # median number of photographs that show a point
    missing: tuple[str, ...]  # photographs that could not be read


def write_orthophoto(folder: Path, view: RunView, surface: SurfaceRasters, tags: dict[str, str]) -> OrthoSummary | None:
    """Write orthophoto.tif (RGB and alpha), overlap.tif and gsd.tif; None when no photograph can be read.

    The photographs are read again from where they were; those that cannot be are left out and named.
    """
    import rasterio

    views = camera_views(view)
    if not views or not view.footprints:
        return None
    boxes = ground_boxes(view)
    gsd_m = float(np.median([item.gsd_m for item in view.footprints]))
    export = view.options.export
    pixel_m = export.ortho_m or (gsd_m * FAST_RATIO if export.orthophoto == "fast" else gsd_m)
    ratio = PLAN_RATIO if pixel_m * PLAN_RATIO > surface.grid.pixel_m else round(surface.grid.pixel_m / pixel_m)
    ratio = int(np.clip(ratio, 1, 16))
    grid = _grid(surface.grid, pixel_m, ratio)
    plan_grid = Grid(grid.west, grid.north, pixel_m * ratio, grid.width // ratio, grid.height // ratio)
    photographs = _Photographs(view.shots, gsd_m / pixel_m)
    with rasterio.open(surface.paths["dsm"]) as dsm:
        heights = _Heights(dsm, plan_grid, max(BRIDGED * _flying_height_m(view), view.options.export.fill_holes))
        samples, sharpness = _colour_samples(view, views, boxes, heights, photographs)
        factors = gains(samples)
        lack = sharpness_lack(sharpness)
        if not lack:
            return None
        views = {index: replace(item, blur=lack[index]) for index, item in views.items() if index in lack}
        writer = _Writer(folder, view, grid, plan_grid, tags)
        with writer:
            windows = list(plan_grid.windows(WINDOW_PX // ratio))
            for done, window in enumerate(windows):
                view.checkpoint("orthophoto", done, len(windows))
                writer.add(
                    *window, *_window(view, views, boxes, plan_grid, heights, window, ratio, photographs, factors)
                )
    return OrthoSummary(
        folder / "orthophoto.tif",
        pixel_m,
        grid.width,
        grid.height,
        writer.covered_share,
        spread(samples, {}),
        spread(samples, factors),
        gsd_m,
        writer.median_overlap,
        tuple(sorted(photographs.missing)),
    )


def camera_views(view: RunView) -> dict[int, View]:
    """Return the placed photographs for the plan."""
    level = view.frame.level_from_map
    return {
        camera.index: View(
            camera.index,
            camera.camera,
            level.apply_to_pose(view.state.map_from_cam(camera.index)),
            camera.world_from_cam.translation,
        )
        for camera in view.cameras
    }


def ground_boxes(view: RunView) -> dict[int, Float]:
    """Return the box (west, south, east, north) of each photograph's footprint, a quarter larger."""
    boxes = {}
    for item in view.footprints:
        low, high = item.outline.min(axis=0), item.outline.max(axis=0)
        margin = 0.25 * (high - low)
        boxes[item.number - 1] = np.concatenate([low - margin, high + margin])
    return boxes


def _flying_height_m(view: RunView) -> float:
    """Return the median height of the cameras above the ground, from the ground sampling distances."""
    by_number = {item.number - 1: item.gsd_m for item in view.footprints}
    heights = [by_number[c.index] * max(c.camera.fx, c.camera.fy) for c in view.cameras if c.index in by_number]
    return float(np.median(heights))


def _grid(surface: Grid, pixel_m: float, ratio: int) -> Grid:
    cell = pixel_m * ratio
    west, north = np.floor(surface.west / cell) * cell, np.ceil(surface.north / cell) * cell
    width = int(np.ceil((surface.west + surface.width * surface.pixel_m - west) / cell - BORDER_M))
    height = int(np.ceil((north - surface.north + surface.height * surface.pixel_m) / cell - BORDER_M))
    return Grid(float(west), float(north), pixel_m, width * ratio, height * ratio)


class _Heights:
    """The surface model at the pixels of the plan; its gaps, up to a distance, are bridged by a coarse surface."""

    def __init__(self, dataset: Any, grid: Grid, bridged_m: float) -> None:
        self.dataset, self.grid = dataset, grid
        step = max(1.0, max(dataset.width, dataset.height) / COARSE_PX)
        shape = max(1, int(dataset.height / step)), max(1, int(dataset.width / step))
        coarse = dataset.read(1, out_shape=shape)
        self._cell_m = dataset.transform.a * dataset.width / shape[1], dataset.transform.a * dataset.height / shape[0]
        known = coarse != np.float32(NODATA)
        reach = max(2, round(bridged_m / self._cell_m[0]))
        inside = slice(reach, reach + shape[0]), slice(reach, reach + shape[1])
        self._wanted = closed(np.pad(known, reach), reach)[inside].astype(np.float32)
        self._coarse = interpolated(np.where(known, coarse, 0.0), known)

    def window(self, row: int, column: int, height: int, width: int) -> Float:
        """Return heights (height, width) of a window of the plan, which may reach outside; NaN where unknown."""
        import cv2

        values = self._nearest(row, column, height, width)
        known = values != np.float32(NODATA)
        x, y = self.grid.centres(row, column, height, width)
        place = self.dataset.transform
        at_x, at_y = np.meshgrid((x - place.c) / self._cell_m[0] - 0.5, (place.f - y) / self._cell_m[1] - 0.5)
        at = at_x.astype(np.float32), at_y.astype(np.float32)
        coarse = cv2.remap(self._coarse, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        wanted = known | (cv2.remap(self._wanted, *at, cv2.INTER_LINEAR) > 0.5)
        steady = cv2.medianBlur(np.where(known, values, coarse).astype(np.float32), 3)
        return np.where(wanted, steady, np.nan).astype(np.float32)

    def _nearest(self, row: int, column: int, height: int, width: int) -> Float:
        from rasterio.windows import Window

        grid, place, dataset = self.grid, self.dataset.transform, self.dataset
        x, y = grid.centres(row, column, height, width)
        columns = np.floor((x - place.c) / place.a).astype(int)
        rows = np.floor((place.f - y) / place.a).astype(int)
        inside_x, inside_y = (columns >= 0) & (columns < dataset.width), (rows >= 0) & (rows < dataset.height)
        values = np.full((height, width), NODATA, np.float32)
        if inside_x.any() and inside_y.any():
            columns, rows = columns[inside_x], rows[inside_y]
            window = Window(columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1)
            read = dataset.read(1, window=window)
            values[np.ix_(inside_y, inside_x)] = read[np.ix_(rows - rows[0], columns - columns[0])]
        return values


class _Photographs:
    """Decoded photographs, the latest ones in memory, no larger than the orthophoto needs them."""

    def __init__(self, shots: Mapping[int, Shot], scale: float) -> None:
        self._shots, self._scale = shots, min(1.0, scale * 1.1)
        self._cached: OrderedDict[int, tuple[UInt8, UInt8, PixelMap, PixelMap]] = OrderedDict()
        self.missing: set[str] = set()

    def small(self, index: int) -> tuple[UInt8, PixelMap] | None:
        """Return a reduced photograph and the map to its pixels; None when it cannot be read."""
        return self._read(index, SAMPLE_PX)

    def get(self, index: int) -> tuple[UInt8, UInt8, PixelMap, PixelMap] | None:
        """Return a photograph, its broad colours, and the maps from the photograph's pixels to theirs."""
        import cv2

        if index in self._cached:
            self._cached.move_to_end(index)
            return self._cached[index]
        shot = self._shots[index]
        longest = max(shot.width_px, shot.height_px)
        read = self._read(index, max(SAMPLE_PX, round(longest * self._scale)))
        if read is None:
            return None
        rgb, from_photo = read
        size = max(2, round(rgb.shape[1] / BROAD_PX)), max(2, round(rgb.shape[0] / BROAD_PX))
        broad = cv2.GaussianBlur(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
        to_broad = PixelMap(size[0] / shot.width_px, size[1] / shot.height_px)
        self._cached[index] = rgb, broad, from_photo, to_broad
        while sum(item[0].nbytes for item in self._cached.values()) > MAX_CACHE_BYTES and len(self._cached) > 1:
            self._cached.popitem(last=False)
        return self._cached[index]

    def _read(self, index: int, longest_px: int) -> tuple[UInt8, PixelMap] | None:
        shot = self._shots[index]
        if shot.name in self.missing:
            return None
        try:
            image = load_working_image(shot, longest_px)
        except (PhotographError, OSError):
            self.missing.add(shot.name)
            return None
        return image.rgb, image.working_from_photo


def _window(
    view: RunView,
    views: Mapping[int, View],
    boxes: Mapping[int, Float],
    grid: Grid,
    heights: _Heights,
    window: tuple[int, int, int, int],
    ratio: int,
    photographs: _Photographs,
    factors: Mapping[int, Float],
) -> tuple[UInt8, Plan]:
    """Return a window of the orthophoto (4, H, W) and its plan."""
    row, column, height, width = window
    margin = int(np.clip(OCCLUDER_M / grid.pixel_m, 2, MAX_MARGIN_PX))
    around = heights.window(row - margin, column - margin, height + 2 * margin, width + 2 * margin)
    # One pixel more than the window on each side, for the interpolation between them.
    inner = slice(margin - 1, margin + height + 1), slice(margin - 1, margin + width + 1)
    west, north = grid.west + column * grid.pixel_m, grid.north - row * grid.pixel_m
    box = np.array([west, north - height * grid.pixel_m, west + width * grid.pixel_m, north])
    near = views_near(views, boxes, box)
    plan = plan_window(near, view.frame, grid, row - margin, column - margin, around, inner)
    core = slice(1, -1), slice(1, -1)
    rgba = _painted(plan, ratio, photographs, factors)
    return rgba, Plan((), plan.seen[core], plan.overlap[core], plan.gsd_m[core])


def _painted(plan: Plan, ratio: int, photographs: _Photographs, factors: Mapping[int, Float]) -> UInt8:
    """Return the window (4, H, W) of a plan that is one pixel larger on each side.

    Colour = sum d_i fine_i + sum (b_i - d_i) broad_i, with narrow weights d and wide ones b: details change over from
    photograph to photograph within few pixels, broad colours over many. The second sum is smooth, and is made at the
    pixels of the plan.
    """
    import cv2

    rows, columns = plan.seen.shape
    shape = rows * ratio, columns * ratio
    fine, details = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    broad, broads = np.zeros((rows, columns, 3), np.float32), np.zeros((rows, columns), np.float32)
    for share in plan.shares:
        photograph = photographs.get(share.index)
        if photograph is None:
            continue
        rgb, small, from_photo, to_small = photograph
        factor = np.asarray(factors.get(share.index, np.ones(3)), np.float32)
        pixels = np.nan_to_num(share.pixels, nan=-1e4)
        broad += (share.broad - share.detail)[..., None] * (_sampled(small, to_small, pixels) * factor)
        broads += share.broad
        box = _box(share.detail > 0.01)
        if box is None:
            continue
        large = slice(box[0].start * ratio, box[0].stop * ratio), slice(box[1].start * ratio, box[1].stop * ratio)
        size = (box[1].stop - box[1].start) * ratio, (box[0].stop - box[0].start) * ratio
        at = cv2.resize(np.ascontiguousarray(pixels[box]), size, interpolation=cv2.INTER_LINEAR)
        weight = cv2.resize(np.ascontiguousarray(share.detail[box]), size, interpolation=cv2.INTER_LINEAR)
        fine[large] += _sampled(rgb, from_photo, at) * (weight[..., None] * factor)
        details[large] += weight
    size = shape[1], shape[0]
    covered = (cv2.resize(plan.seen.astype(np.float32), size) > 0.5) & (details > 0.05)
    covered &= cv2.resize(broads, size) > 0.05
    broad /= np.where(broads > 0.05, broads, 1.0)[..., None]
    fine /= np.where(covered, details, 1.0)[..., None]
    fine += cv2.resize(broad, size, interpolation=cv2.INTER_LINEAR)
    inner = slice(ratio, -ratio), slice(ratio, -ratio)
    rgba = np.zeros((4, shape[0] - 2 * ratio, shape[1] - 2 * ratio), np.uint8)
    colour = np.where(covered[inner][..., None], np.clip(fine[inner] + 0.5, 0, 255), 0)
    rgba[:3], rgba[3] = colour.transpose(2, 0, 1), np.where(covered[inner], 255, 0)
    return rgba


def _box(mask: Bool) -> tuple[slice, slice] | None:
    """Return the rows and columns that hold all true pixels, and one more around them."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    height, width = mask.shape
    return (
        slice(max(int(rows[0]) - 1, 0), min(int(rows[-1]) + 2, height)),
        slice(max(int(columns[0]) - 1, 0), min(int(columns[-1]) + 2, width)),
    )


def _sampled(image: UInt8, from_photo: PixelMap, pixels: Float) -> Float:
    """Return the colours (H, W, 3) float32 of an image at pixels (H, W, 2) of the photograph."""
    import cv2

    scale = np.array([from_photo.scale_x, from_photo.scale_y], np.float32)
    at = np.asarray(pixels, np.float32) * scale - np.float32(0.5)
    found = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32)


def _colour_samples(
    view: RunView,
    views: Mapping[int, View],
    boxes: Mapping[int, Float],
    heights: _Heights,
    photographs: _Photographs,
) -> tuple[ColourSamples, dict[int, float]]:
    """Return colours of the same surface points in the photographs, and how sharp each photograph is."""
    import cv2

    points, level = _sample_points(view, heights, len(views))
    parts, sharpness = [], {}
    for done, (index, item) in enumerate(views.items()):
        view.checkpoint("comparing colours", done, len(views))
        read = photographs.small(index)
        if read is None:
            continue
        rgb, from_photo = read
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        sharpness[index] = float(cv2.Laplacian(grey, cv2.CV_32F).std() / max(float(grey.std()), 1.0))
        box = boxes.get(index)
        if box is None:
            continue
        near = np.flatnonzero(
            (points[:, 0] > box[0]) & (points[:, 1] > box[1]) & (points[:, 0] < box[2]) & (points[:, 1] < box[3])
        )
        in_camera = item.level_from_cam.inverse().apply(level[near])
        pixels = item.camera.project(in_camera)
        with np.errstate(invalid="ignore"):
            border = np.minimum(pixels, (item.camera.width, item.camera.height) - pixels).min(axis=1)
            ok = border > 0.03 * item.camera.width
        smooth = cv2.blur(rgb, (9, 9))
        at = np.floor(from_photo.apply(pixels[ok])).astype(int)
        parts.append(
            ColourSamples(np.full(int(ok.sum()), index), near[ok], smooth[at[:, 1], at[:, 0]].astype(np.float64))
        )
    return joined(parts), sharpness


def _sample_points(view: RunView, heights: _Heights, photographs: int) -> tuple[Float, Float]:
    """Return surface points (N, 3) spread over the survey, in the export and in the level frame."""
    dataset = heights.dataset
    step = max(1.0, np.sqrt(dataset.width * dataset.height / max(2000, SAMPLES * photographs // 6)))
    shape = max(1, int(dataset.height / step)), max(1, int(dataset.width / step))
    z = dataset.read(1, out_shape=shape)
    x = dataset.transform.c + (np.arange(shape[1]) + 0.5) * dataset.width / shape[1] * dataset.transform.a
    y = dataset.transform.f - (np.arange(shape[0]) + 0.5) * dataset.height / shape[0] * dataset.transform.a
    points = np.stack([*np.meshgrid(x, y), z], axis=-1).reshape(-1, 3).astype(float)
    points = points[points[:, 2] != NODATA]
    return points, view.frame.world.to_enu(points) if view.frame.world else points


class _Writer:
    """The three rasters of the pass, written side by side; a context manager."""

    def __init__(self, folder: Path, view: RunView, grid: Grid, plan_grid: Grid, tags: dict[str, str]) -> None:
        self._ratio = grid.width // plan_grid.width
        self._ortho = CogWriter(
            folder / "orthophoto.tif", grid, view.crs, "uint8", ["red", "green", "blue", "alpha"], alpha=True, tags=tags
        )
        self._overlap = CogWriter(
            folder / "overlap.tif", plan_grid, view.crs, "uint16", ["photographs that show it"], nodata=0, tags=tags
        )
        self._gsd = CogWriter(
            folder / "gsd.tif",
            plan_grid,
            view.crs,
            "float32",
            ["ground sampling distance of the best view, m"],
            nodata=NODATA,
            tags=tags,
        )
        self._surface = self._seen = 0
        self._counts = np.zeros(1024, np.int64)

    def __enter__(self) -> _Writer:
        for writer in (self._ortho, self._overlap, self._gsd):
            writer.__enter__()
        return self

    def add(self, row: int, column: int, height: int, width: int, rgba: UInt8, plan: Plan) -> None:
        """Write one window; row and column count pixels of the plan."""
        self._ortho.write(row * self._ratio, column * self._ratio, rgba)
        self._overlap.write(row, column, plan.overlap.astype(np.uint16)[None])
        self._gsd.write(row, column, np.where(np.isfinite(plan.gsd_m), plan.gsd_m, NODATA).astype(np.float32)[None])
        self._surface += int((plan.overlap > 0).sum())
        self._seen += int(plan.seen.sum())
        self._counts += np.bincount(np.minimum(plan.overlap.ravel(), 1023), minlength=1024)

    def __exit__(self, *error: Any) -> None:
        for writer in (self._ortho, self._overlap, self._gsd):
            writer.__exit__(*error)

    @property
    def covered_share(self) -> float:
        """The share of what lies in any photograph's frame that one of them shows."""
        return self._seen / self._surface if self._surface else 0.0

    @property
    def median_overlap(self) -> float:
        """The median number of photographs that show a point."""
        counts = self._counts[1:]
        return float(np.searchsorted(np.cumsum(counts), counts.sum() / 2.0) + 1) if counts.any() else 0.0
