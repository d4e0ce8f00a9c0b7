"""The sparse points of one image as a point map, and what confidence means for sparse and dense points alike.

The GSD of a point is its depth over the focal length of the working image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..adjust.sparse_model import SparseModel
from ..geometry.arrays import Bool, Float, Int
from ..records import Features

SIGMA_HALF_GSD = 2.5  # depth precision at which a point is worth half
KEYPOINT_SIGMA_PX = 0.5
CELL_MARGIN_PX = 0.5  # of the point map: a sparse point must project so near to the pixel of its keypoint


@dataclass(frozen=True)
class DenseView:
    """The point map of one image."""

    points: Float  # (H, W, 3) float32, local frame; NaN where nothing is known
    confidence: Float  # (H, W) float32 in 0..1; 0 where points are NaN
    sparse: Bool  # (H, W) where the point is a sparse one


def sparse_view(
    index: int, model: SparseModel, keys: Mapping[int, str], features: Features, grid: tuple[int, int]
) -> DenseView:
    """Return a point map (height, width of `grid`) that holds only the sparse points of one image's keypoints.

    A point lies in the pixel its keypoint falls into, of several the one of the lowest feature index, so that a
    keypoint has the same pixel in every subset. Points that project farther off than `CELL_MARGIN_PX` are left out.
    """
    width, height = grid
    points = np.full((height, width, 3), np.nan, np.float32)
    confidence = np.zeros((height, width), np.float32)
    track = model.tracks[index]
    if len(track.features) == 0:
        return DenseView(points, confidence, confidence > 0.0)
    working = model.cameras[keys[index]]
    camera = working.resized(width, height)
    places = features.pixels[track.features].astype(float) * (width / working.width, height / working.height)
    cells = np.floor(places).astype(int)
    in_camera = model.local_from_cam[index].inverse().apply(model.points[track.points])
    off_centre = np.abs(camera.project(in_camera) - (cells + 0.5)).max(axis=-1)
    inside = ((cells >= 0) & (cells < grid)).all(axis=-1)
    good = np.flatnonzero(inside & (off_centre <= 0.5 + CELL_MARGIN_PX))[::-1]  # the lowest index is written last
    columns, rows = cells[good].T
    points[rows, columns] = model.points[track.points[good]]
    confidence[rows, columns] = _confidence(index, model, keys)[good]
    return DenseView(points, confidence, confidence > 0.0)


def ray_angles(index: int, other: int, model: SparseModel, points: Int) -> Float:
    """Return the angles (N,) in rad between the rays of two images to sparse points (N,)."""
    first, second = (model.points[points] - model.local_from_cam[i].translation for i in (index, other))
    cosine = (first * second).sum(axis=-1) / (np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1))
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def precision_worth(sigma: Float, depth: Float, focal_px: float) -> Float:
    """Return 1 for a perfect depth, 1/2 where its standard deviation is `SIGMA_HALF_GSD`."""
    with np.errstate(invalid="ignore"):
        return np.asarray(1.0 / (1.0 + (sigma * focal_px / (SIGMA_HALF_GSD * depth)) ** 2))


def _confidence(index: int, model: SparseModel, keys: Mapping[int, str]) -> Float:
    """Return the confidences (M,) of an image's triangulated points.

    The formal depth precision from the reprojection error and all triangulation angles, times the chance that the
    track holds no mismatch, which halves with every image beyond the first.
    """
    own = model.tracks[index].points
    camera = model.cameras[keys[index]]
    squared_sines = np.zeros(len(own))
    for other in model.local_from_cam:
        if other != index:
            shared = np.isin(own, model.tracks[other].points)
            squared_sines[shared] += np.sin(ray_angles(index, other, model, own[shared])) ** 2
    error_px = np.hypot(model.reprojection_px[own], KEYPOINT_SIGMA_PX)
    with np.errstate(divide="ignore"):
        relative_sigma = error_px / camera.fx / np.sqrt(squared_sines)
    worth = precision_worth(relative_sigma, np.ones(len(own)), camera.fx)
    return np.asarray(worth * (1.0 - 0.5 ** (model.track_length[own] - 1.0)))
