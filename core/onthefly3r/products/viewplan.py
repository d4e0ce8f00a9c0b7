"""Which photographs see a piece of the surface, how well, and how much each gives to the orthophoto."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from .cog import Grid
from .exportframe import ExportFrame
from .heightmodels import closed

MAX_CANDIDATES = 12  # photographs whose view is tested for what stands in it, per window
MAX_STEPS = 96  # of a ray on its way to the camera
TOLERANCE_PX = 1.5  # a ray this far below the surface is still free
EDGE = 0.03  # of the image's longer side: views nearer to the edge of the photograph are worth less
EDGE_COST = 0.3  # radians at the very edge
BLUR_COST = 0.25  # radians for each factor e of lacking sharpness
SLIT_PX = 4.0  # what no view shows, but is not wider than twice this, is filled nevertheless
SEAM_PX = 2.0  # width of the blend of details, plan pixels
WIDE_SEAM_PX = 24.0  # and of the blend of broad colours


@dataclass(frozen=True)
class View:
    """A placed photograph as the plan sees it."""

    index: int  # shot index
    camera: Camera  # photograph size
    level_from_cam: Rigid3
    centre: Float  # (3,) in the export frame
    blur: float = 0.0  # how much less sharp it is than the others, natural logarithm, >= 0


@dataclass(frozen=True)
class Share:
    """What one photograph gives to a window of the plan."""

    index: int  # shot index
    pixels: Float  # (H, W, 2) float32 upright photograph, where each plan pixel's surface point is seen
    detail: Float  # (H, W) float32 weight of its details; the weights of all photographs add up to 1
    broad: Float  # (H, W) float32 weight of its broad colours


@dataclass(frozen=True)
class Plan:
    """All that is known of a window."""

    shares: tuple[Share, ...]
    seen: Bool  # (H, W) whether any photograph shows it
    overlap: Int  # (H, W) photographs that have it in their frame
    gsd_m: Float  # (H, W) float32 ground sampling distance of the best view, NaN where there is none


def plan_window(
    views: Sequence[View],
    frame: ExportFrame,
    grid: Grid,
    row: int,
    column: int,
    heights_m: Float,
    inner: tuple[slice, slice],
) -> Plan:
    """Return the plan of a window.

    Args:
        views: photographs that may see it.
        frame: tells the level frame of points in the export frame.
        grid: of the surface.
        row: of the first pixel of `heights_m`, which may lie outside the grid.
        column: of the same.
        heights_m: (h, w) surface around the window in the export frame, NaN where unknown.
        inner: the window in `heights_m`; the rest around it is what may stand in the way.
    """
    x, y = grid.centres(row, column, *heights_m.shape)
    points = np.stack([*np.meshgrid(x, y), heights_m], axis=-1)[inner]
    known = np.isfinite(points[..., 2])
    shape = known.shape
    gsd: Float = np.full(shape, np.nan, np.float32)
    overlap: Int = np.zeros(shape, np.int32)
    if not known.any() or not views:
        return Plan((), np.zeros(shape, bool), overlap, gsd)
    level = _level_points(frame, points, known)
    found: list[tuple[View, Float, Float, Float]] = []
    for view in views:
        in_camera = view.level_from_cam.inverse().apply(level)
        with np.errstate(invalid="ignore"):
            pixels = view.camera.project(in_camera)
            border = np.minimum(pixels, (view.camera.width, view.camera.height) - pixels).min(axis=-1)
            inside = known & (border > 1.0) & _undistorted_in_frame(view.camera, in_camera)
        if not inside.any():
            continue
        overlap += inside
        distance = np.linalg.norm(level - view.level_from_cam.translation, axis=-1)
        off_nadir = np.arccos(np.clip((view.level_from_cam.translation[2] - level[..., 2]) / distance, -1.0, 1.0))
        reach = EDGE * max(view.camera.width, view.camera.height)
        cost = off_nadir + EDGE_COST * np.clip(1.0 - border / reach, 0.0, 1.0) ** 2 + BLUR_COST * view.blur
        cost = np.where(inside, cost, np.inf).astype(np.float32)
        gsd_m = (distance / max(view.camera.fx, view.camera.fy)).astype(np.float32)
        found.append((view, np.asarray(pixels, np.float32), cost, gsd_m))
    kept = _promising(found)
    costs = np.stack([item[2] for item in kept]) if kept else np.full((1, *shape), np.inf, np.float32)
    surface = _Surface(grid, row, column, heights_m, inner)
    hidden = np.stack([surface.hidden_from(view.centre, np.isfinite(cost)) for view, _, cost, _ in kept] or [~known])
    # What stands in the way of every view leaves slits; the narrow ones take the best view nevertheless.
    free = (np.isfinite(costs) & ~hidden).any(axis=0)
    slit = closed(free, SLIT_PX) & ~free
    costs[hidden & ~slit] = np.inf
    best = costs.min(axis=0)
    seen = np.isfinite(best)
    height_m = float(np.median([item[0].centre[2] for item in kept]) - np.nanmedian(heights_m)) if kept else 1.0
    step = grid.pixel_m / max(height_m, grid.pixel_m)  # how far the angle of a view turns from pixel to pixel
    if kept:
        gsd = np.where(seen, np.take_along_axis(np.stack([g for *_, g in kept]), costs.argmin(axis=0)[None], 0)[0], gsd)
    detail, broad = _weights(costs, best, SEAM_PX * step), _weights(costs, best, WIDE_SEAM_PX * step)
    shares = [
        Share(view.index, pixels, detail[k], broad[k])
        for k, (view, pixels, _, _) in enumerate(kept)
        if broad[k].max() > 0.01 or detail[k].max() > 0.01
    ]
    return Plan(tuple(shares), seen, overlap, gsd)


def views_near(views: Mapping[int, View], boxes: Mapping[int, Float], box: Float) -> list[View]:
    """Return the photographs whose ground box (west, south, east, north) meets a window's."""
    return [
        view
        for index, view in views.items()
        if index in boxes
        and boxes[index][0] < box[2]
        and boxes[index][2] > box[0]
        and boxes[index][1] < box[3]
        and boxes[index][3] > box[1]
    ]


def _level_points(frame: ExportFrame, points: Float, known: Bool) -> Float:
    """Return export-frame points (H, W, 3) in the level frame, by the affine map that holds over a window."""
    if frame.world is None:
        return points
    chosen = points[known]
    low, high = chosen.min(axis=0), chosen.max(axis=0)
    high = np.maximum(high, low + 1.0)
    corners = np.stack(np.meshgrid(*np.stack([low, (low + high) / 2.0, high]).T, indexing="ij"), axis=-1).reshape(-1, 3)
    middle = (low + high) / 2.0
    design = np.column_stack([corners - middle, np.ones(len(corners))])
    coefficients, *_ = np.linalg.lstsq(design, frame.world.to_enu(corners), rcond=None)
    return np.asarray((points - middle) @ coefficients[:3] + coefficients[3])


def _undistorted_in_frame(camera: Camera, in_camera: Float) -> Bool:
    """Return which points lie in the cone of the lens: beyond it, its distortion folds back into the image."""
    corners = camera.rays(np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]]))
    reach = float(np.linalg.norm(corners[:, :2], axis=1).max()) * 1.05
    depth = in_camera[..., 2]
    with np.errstate(invalid="ignore"):
        return np.asarray((depth > 0.0) & (np.hypot(in_camera[..., 0], in_camera[..., 1]) < reach * depth))


def _promising(
    found: list[tuple[View, Float, Float, Float]],
) -> list[tuple[View, Float, Float, Float]]:
    """Return the views that are among the best somewhere in the window."""
    if len(found) <= MAX_CANDIDATES:
        return found
    coarse = np.stack([item[2][::16, ::16].ravel() for item in found])
    rank = np.argsort(np.argsort(coarse, axis=0), axis=0)
    rank[~np.isfinite(coarse)] = len(found)
    order = np.argsort(np.sort(rank, axis=1)[:, : max(1, rank.shape[1] // 8)].mean(axis=1), kind="stable")
    return [found[k] for k in order[:MAX_CANDIDATES]]


def _weights(costs: Float, best: Float, width: float) -> Float:
    """Return weights (K, H, W) that fall off with the cost above the best; they add up to 1 where anything is seen."""
    with np.errstate(invalid="ignore"):
        weights = np.where(np.isfinite(costs), np.exp(-np.minimum((costs - best) / width, 30.0)), 0.0)
    total = weights.sum(axis=0)
    return np.asarray(weights / np.where(total > 0.0, total, 1.0), np.float32)


class _Surface:
    """The surface around a window as what hides parts of it from a camera."""

    def __init__(self, grid: Grid, row: int, column: int, heights_m: Float, inner: tuple[slice, slice]) -> None:
        self._grid, self._row, self._column = grid, row, column
        self._heights = np.where(np.isfinite(heights_m), heights_m, -1e6).astype(np.float32)
        self._inner = inner
        self._top = float(self._heights.max())

    def hidden_from(self, centre: Float, asked: Bool) -> Bool:
        """Return which pixels of the window have something higher between them and a camera."""
        import cv2

        grid = self._grid
        z = self._heights[self._inner]
        rows, columns = np.mgrid[self._inner[0], self._inner[1]].astype(np.float32)
        to_column = np.float32((centre[0] - grid.west) / grid.pixel_m - 0.5 - self._column) - columns
        to_row = np.float32((grid.north - centre[1]) / grid.pixel_m - 0.5 - self._row) - rows
        away_px = np.maximum(np.hypot(to_column, to_row), 1e-3)
        rise = (np.float32(centre[2]) - z) / away_px  # m for each pixel on the way
        step_column, step_row = to_column / away_px, to_row / away_px
        lowest = float(np.where(asked, rise, np.inf).min())
        if not np.isfinite(lowest) or lowest <= 0.0:
            return ~asked
        reach_px = (self._top - float(np.where(asked, z, np.inf).min())) / lowest
        hidden = np.zeros(z.shape, bool)
        tolerance_m = TOLERANCE_PX * grid.pixel_m
        at, steps = 1.5, 0
        while at < reach_px and steps < MAX_STEPS:
            above = cv2.remap(
                self._heights,
                columns + step_column * at,
                rows + step_row * at,
                cv2.INTER_NEAREST,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=-1e6,
            )
            hidden |= above > z + rise * at + tolerance_m
            at, steps = at + max(1.0, 0.06 * at), steps + 1
        # A ragged outline would show as a seam; one pixel more keeps the roof's edge out of the ground beside it.
        kernel = np.ones((3, 3), np.uint8)
        tidy = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        return np.asarray(cv2.dilate(tidy, kernel) > 0)
