"""Dense point maps of a subset's new images by stereo with their best partners, joined with the sparse points.

Depths of a view are measured along z of its camera; a standard deviation counts in depth units. The GSD of a point
is its depth over the focal length of the working image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..adjust.sparse_model import SparseModel
from ..geometry.arrays import Float, UInt8
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from ..records import Features
from .rectify import rectify
from .sparse import DenseView, precision_worth, ray_angles, sparse_view
from .stereo import disparity

__all__ = [
    "DenseView",
    "DepthMap",
    "PosedImage",
    "choose_partners",
    "dense_view",
    "dense_views",
    "merge_depths",
    "pair_depth",
    "sparse_view",
]

BEST_ANGLE_DEG = 14.0  # between the rays of the two images: wide enough to be precise, small enough to match
ANGLE_SPREAD = 0.6  # standard deviation of its logarithm
COVERED_TWICE = 0.35  # worth of a point that an earlier partner sees too
MIN_SHARED_POINTS = 12
CELLS = 6  # per side: where an image has cells without sparse points, something high may stand there,
UNSEEN_RELIEF = 0.8  # at 1 / (1 + 0.8) of the distance when there are none at all
FINER = 2.0  # stereo runs at this multiple of the point map's resolution, at most at that of the image

SIGMA_FACTOR = 2.0  # true over formal standard deviation of disparities: the residuals of a window are correlated
SIGMA_FLOOR_PX = 0.05  # of disparities, from poses and intrinsics
AGREEMENT_SIGMAS, AGREEMENT_GSD = 3.0, 1.0
EDGE_PX = 1.0  # disparities of neighbours farther apart are not interpolated

TRUST_ALONE, TRUST_AGREED, TRUST_DISPUTED = 0.7, 0.95, 0.25
CONFIRMED, CONTRADICTED = 0.6, 0.3  # factors of doubt and of trust for each other view that says so
CHECKING_VIEWS = 2


@dataclass(frozen=True)
class PosedImage:
    """A grey image and where it was taken."""

    grey: UInt8  # (H, W)
    camera: Camera  # at the size of the image
    local_from_cam: Rigid3


@dataclass(frozen=True)
class DepthMap:
    """Depths of one view and how far they can be trusted."""

    depth: Float  # (H, W) float32 local units; NaN where unknown
    sigma: Float  # (H, W) float32 local units
    trust: Float  # (H, W) float32 in 0..1: that the match is right


def dense_views(
    new: Sequence[int],
    images: Mapping[int, UInt8],
    model: SparseModel,
    keys: Mapping[int, str],
    features: Mapping[int, Features],
    grids: Mapping[int, tuple[int, int]],
    partners: int = 2,
    threads: int = 2,
    checkpoint: Callable[[], None] = lambda: None,
) -> dict[int, DenseView]:
    """Return the point maps of those new images that the sparse model has placed, checked against each other.

    At the pixel of a triangulated keypoint the map holds the sparse point itself (`sparse_view`).

    Args:
        new: indices of the images wanted.
        images: working images (H, W, 3) of all members of the subset, RGB.
        model: their sparse model.
        keys: camera key of each image.
        features: local features of each new image, pixels of the working image.
        grids: (width, height) of each new image's point map.
        partners: images that each new one is matched with, at most.
        threads: processor threads.
        checkpoint: called between images; what it raises ends the work.
    """
    placed = [i for i in new if i in model.local_from_cam]
    with ThreadPoolExecutor(max(1, threads)) as pool:
        found = pool.map(lambda i: _depth_map(i, images, model, keys, grids[i], partners), placed)
        maps = {}
        try:
            for i, depth_map in zip(placed, found, strict=True):
                maps[i] = depth_map
                checkpoint()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # else the end of `with` waits for all images
            raise
        checked = pool.map(lambda i: _cross_check(i, maps, model, keys), placed)
        maps = dict(zip(placed, list(checked), strict=True))
    views = {}
    for i in placed:
        dense = _to_view(i, maps[i], model, keys)
        sparse = sparse_view(i, model, keys, features[i], grids[i])
        chosen = sparse.confidence > 0.0
        views[i] = DenseView(
            np.where(chosen[..., None], sparse.points, dense.points),
            np.where(chosen, sparse.confidence, dense.confidence),
            chosen,
        )
    return views


def dense_view(
    index: int,
    images: Mapping[int, UInt8],
    model: SparseModel,
    keys: Mapping[int, str],
    grid: tuple[int, int],
    partners: int = 2,
) -> DenseView:
    """Return the point map of one placed image from stereo alone; arguments as for `dense_views`."""
    return _to_view(index, _depth_map(index, images, model, keys, grid, partners), model, keys)


def choose_partners(index: int, model: SparseModel, count: int) -> list[int]:
    """Return up to `count` placed images to match with, best first.

    Every sparse point of the image is worth a log-normal of the angle between the two rays that see it, less once an
    earlier partner sees it too.
    """
    own = model.tracks[index].points
    worth = np.ones(len(own))
    values = {}
    for other in sorted(model.local_from_cam):
        shared = np.isin(own, model.tracks[other].points) if other != index else np.zeros(len(own), bool)
        if np.count_nonzero(shared) >= MIN_SHARED_POINTS:
            angle = np.degrees(ray_angles(index, other, model, own))
            octaves = np.log(np.maximum(angle, 0.01) / BEST_ANGLE_DEG) / ANGLE_SPREAD
            values[other] = np.where(shared, np.exp(-0.5 * octaves**2), 0.0)
    chosen: list[int] = []
    while values and len(chosen) < count:
        best = max(values, key=lambda other: (float(values[other] @ worth), -other))
        worth = np.where(values.pop(best) > 0.1, COVERED_TWICE * worth, worth)
        chosen.append(best)
    return chosen


def _depth_map(
    index: int,
    images: Mapping[int, UInt8],
    model: SparseModel,
    keys: Mapping[int, str],
    grid: tuple[int, int],
    partners: int,
) -> DepthMap:
    camera = model.cameras[keys[index]]
    measured = [
        found
        for other in choose_partners(index, model, partners)
        if (found := _stereo_depth(index, other, images, model, keys, grid)) is not None
    ]
    if not measured:
        unknown = np.full((grid[1], grid[0]), np.nan, np.float32)
        return DepthMap(unknown, unknown, np.zeros_like(unknown))
    return merge_depths([depth for depth, _ in measured], [sigma for _, sigma in measured], camera.fx)


def _stereo_depth(
    index: int,
    other: int,
    images: Mapping[int, UInt8],
    model: SparseModel,
    keys: Mapping[int, str],
    grid: tuple[int, int],
) -> tuple[Float, Float] | None:
    """Return what `pair_depth` finds for two images of a sparse model."""
    import cv2

    left, right = (
        PosedImage(cv2.cvtColor(images[i], cv2.COLOR_RGB2GRAY), model.cameras[keys[i]], model.local_from_cam[i])
        for i in (index, other)
    )
    points = model.points[model.tracks[index].points]
    return pair_depth(left, right, points, left.camera.resized(*grid))


def pair_depth(left: PosedImage, right: PosedImage, points: Float, grid: Camera) -> tuple[Float, Float] | None:
    """Return depths and their standard deviations (H, W) float32 from one pair, None where it cannot be rectified.

    Args:
        left: the image whose depths are wanted.
        right: its partner.
        points: (N, 3) that the left image sees, local frame: they tell which depths to look for.
        grid: camera of the depth map, at the pose of the left image; it may be free of distortion.
    """
    import cv2

    focal_px = min(left.camera.fx, FINER * grid.fx)
    poses = left.local_from_cam, right.local_from_cam
    nearer = 1.0 + UNSEEN_RELIEF * _unseen_share(poses[0].inverse().apply(points), left.camera)
    pair = rectify(left.camera, poses[0], right.camera, poses[1], points, focal_px, nearer)
    if pair is None:
        return None
    found, found_sigma = disparity(*pair.images(left.grey, left.camera, right.grey, right.camera), pair.disparities)
    xy, z = pair.pixels(_grid_rays(grid))
    x, y = np.ascontiguousarray(xy[..., 0]), np.ascontiguousarray(xy[..., 1])
    nearest, linear = (
        cv2.remap(found, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
        for how in (cv2.INTER_NEAREST, cv2.INTER_LINEAR)
    )
    sampled = np.where(np.abs(linear - nearest) < EDGE_PX, linear, nearest)
    sigma_px = cv2.remap(found_sigma, x, y, cv2.INTER_NEAREST)
    sigma_px = np.sqrt((SIGMA_FACTOR * sigma_px) ** 2 + np.float32(SIGMA_FLOOR_PX**2))
    rectified_depth = pair.depth(sampled)
    depth = rectified_depth / z
    sigma = sigma_px * depth * rectified_depth / np.float32(pair.focal_px * pair.baseline)
    return depth, sigma


def _unseen_share(in_camera: Float, camera: Camera) -> float:
    """Return the share of an image's cells in which no sparse point (N, 3) lies."""
    cells = np.floor(CELLS * camera.project(in_camera) / (camera.width, camera.height))
    cells = cells[((cells >= 0) & (cells < CELLS)).all(axis=-1)]
    return 1.0 - len(np.unique(cells, axis=0)) / CELLS**2


@lru_cache(maxsize=8)
def _grid_rays(camera: Camera) -> Float:
    """Return the rays (H, W, 3) float32 through all pixel centres; kept, as undoing the distortion takes long."""
    return camera.rays(camera.pixel_centres()).astype(np.float32)


def merge_depths(depths: Sequence[Float], sigmas: Sequence[Float], focal_px: float) -> DepthMap:
    """Join the depths of several partners: the most precise one and those that agree with it, weighted."""
    depth = np.stack(depths)
    sigma = np.where(np.isfinite(depth), np.stack(sigmas), np.float32(np.inf))
    best = sigma.argmin(axis=0)[None]
    best_depth, best_sigma = np.take_along_axis(depth, best, 0)[0], np.take_along_axis(sigma, best, 0)[0]
    tolerance = AGREEMENT_SIGMAS * np.hypot(sigma, best_sigma) + np.float32(AGREEMENT_GSD / focal_px) * best_depth
    agrees = np.abs(depth - best_depth) <= tolerance
    agrees &= np.isfinite(sigma)
    weight = np.where(agrees, sigma, np.float32(np.inf)) ** -2
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(agrees, weight * depth, np.float32(0.0)).sum(axis=0) / total
        mean_sigma = total**-0.5
    support, seen = agrees.sum(axis=0), np.isfinite(sigma).sum(axis=0)
    trust = np.where(support >= 2, TRUST_AGREED, np.where(seen >= 2, TRUST_DISPUTED, TRUST_ALONE))
    return DepthMap(mean, mean_sigma, np.where(seen > 0, trust, 0.0).astype(np.float32))


def _cross_check(index: int, maps: Mapping[int, DepthMap], model: SparseModel, keys: Mapping[int, str]) -> DepthMap:
    """Let other views confirm a depth, or contradict it where they look through it."""
    import cv2

    own = maps[index]
    known = np.isfinite(own.depth)
    if not known.any():
        return own
    points = _points(index, own, model, keys)[known]
    sigma = own.sigma[known]
    doubt_factor, trust_factor = np.ones(len(points), np.float32), np.ones(len(points), np.float32)
    for other in _checking_views(index, maps, model):
        theirs, camera = maps[other], model.cameras[keys[other]]
        height, width = theirs.depth.shape
        in_camera = cv2.transform(points[:, None], model.local_from_cam[other].inverse().matrix()[:3])[:, 0]
        pixels = camera.resized(width, height).project(in_camera)
        inside = np.asarray(((pixels >= 0.0) & (pixels < (width, height))).all(axis=-1))  # False at NaN
        columns, rows = np.where(inside[:, None], pixels, 0.0).astype(int).T
        depth = in_camera[:, 2]
        seen = inside & (theirs.trust[rows, columns] >= TRUST_ALONE)
        difference = depth - theirs.depth[rows, columns]
        tolerance = AGREEMENT_SIGMAS * np.hypot(sigma, theirs.sigma[rows, columns])
        tolerance = tolerance + 2.0 * AGREEMENT_GSD / camera.fx * depth
        doubt_factor[seen & (np.abs(difference) <= tolerance)] *= CONFIRMED
        trust_factor[seen & (difference < -2.0 * tolerance)] *= CONTRADICTED
    trust = own.trust.copy()
    trust[known] = (1.0 - (1.0 - trust[known]) * doubt_factor) * trust_factor
    return DepthMap(own.depth, own.sigma, trust)


def _checking_views(index: int, maps: Mapping[int, DepthMap], model: SparseModel) -> list[int]:
    """Return the views that share most sparse points."""
    own = model.tracks[index].points
    shared = {other: len(np.intersect1d(own, model.tracks[other].points)) for other in maps if other != index}
    ranked = sorted((other for other in shared if shared[other]), key=lambda other: (-shared[other], other))
    return ranked[:CHECKING_VIEWS]


def _points(index: int, depth_map: DepthMap, model: SparseModel, keys: Mapping[int, str]) -> Float:
    """Return the points (H, W, 3) float32 in the local frame."""
    import cv2

    height, width = depth_map.depth.shape
    rays = _grid_rays(model.cameras[keys[index]].resized(width, height))
    # Not a matrix product: BLAS would start threads for three columns, and waiting for them costs more.
    return np.asarray(cv2.transform(depth_map.depth[..., None] * rays, model.local_from_cam[index].matrix()[:3]))


def _to_view(index: int, depth_map: DepthMap, model: SparseModel, keys: Mapping[int, str]) -> DenseView:
    known = np.isfinite(depth_map.depth)
    precision = precision_worth(depth_map.sigma, depth_map.depth, model.cameras[keys[index]].fx)
    confidence = np.where(known, precision * depth_map.trust, 0.0).astype(np.float32)
    return DenseView(_points(index, depth_map, model, keys), confidence, np.zeros(known.shape, bool))
