"""Epipolar rectification of two posed images: after it, a point lies in the same row of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float, UInt8
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3

DISPARITY_STEP = 32  # SGBM wants multiples of 16, and its images are half as large as ours
MAX_PIXELS = 4.0  # rectified over given pixels: beyond this the baseline lies too near to the viewing direction
MAX_AXIS_COSINE = 0.8  # of the baseline to the viewing directions
RANGE_MARGIN = 0.2  # disparities searched beyond those of the given points, relative to their range
BORDER_SAMPLES = 32


@dataclass(frozen=True)
class Rectification:
    """Two pinhole cameras of one rotation, side by side, and which depths their disparities stand for.

    Rectified pixels count from the centre of the first pixel, as OpenCV's do. A point at depth z of the rectified
    frame has the disparity x_left - x_right = focal_px * baseline / z - offset_px.
    """

    rect_from_left: Float  # (3, 3) rotation
    rect_from_right: Float  # (3, 3) rotation
    focal_px: float
    baseline: float  # local units
    centre: tuple[float, float]  # principal point of the left image
    offset_px: float
    disparities: int  # disparities run from 0 to this
    width: int
    height: int

    def images(self, left: UInt8, left_camera: Camera, right: UInt8, right_camera: Camera) -> tuple[UInt8, UInt8]:
        """Return both images (height, width) as the rectified cameras see them, 0 where there is no image."""
        cx, cy = self.centre
        return (
            self._remap(left, left_camera, self.rect_from_left, cx, cy),
            self._remap(right, right_camera, self.rect_from_right, cx + self.offset_px, cy),
        )

    def pixels(self, rays: Float) -> tuple[Float, Float]:
        """Return where rays (H, W, 3) of the left camera pierce the left rectified image, and z of the turned rays.

        The result is (pixels (H, W, 2), z (H, W)); the point at depth t along a ray has the rectified depth t * z.
        """
        import cv2

        turned = cv2.transform(rays, self.rect_from_left)
        z = turned[..., 2]
        xy = turned[..., :2] * (np.float32(self.focal_px) / z)[..., None] + np.asarray(self.centre, rays.dtype)
        return xy, z

    def depth(self, disparity: Float) -> Float:
        """Return the rectified depths of disparities, local units; NaN beyond infinity."""
        total = disparity + np.float32(self.offset_px)
        return np.float32(self.focal_px * self.baseline) / np.where(total > 0.0, total, np.float32(np.nan))

    def _remap(self, image: UInt8, camera: Camera, rect_from_cam: Float, cx: float, cy: float) -> UInt8:
        import cv2

        given = camera.matrix()
        given[:2, 2] -= 0.5  # OpenCV counts pixels from the centre of the first one
        wanted = np.array([[self.focal_px, 0.0, cx], [0.0, self.focal_px, cy], [0.0, 0.0, 1.0]])
        maps = cv2.initUndistortRectifyMap(
            given, np.array(camera.distortion), rect_from_cam, wanted, (self.width, self.height), cv2.CV_16SC2
        )
        return np.asarray(cv2.remap(cv2.max(image, 1), *maps, cv2.INTER_LINEAR))


def rectify(
    left: Camera,
    local_from_left: Rigid3,
    right: Camera,
    local_from_right: Rigid3,
    points: Float,
    focal_px: float,
    nearer: float,
) -> Rectification | None:
    """Return the rectification of a pair, or None where its baseline runs too near to the viewing directions.

    x runs along the baseline from left to right, z along the mean viewing direction, whatever way the cameras are
    turned about it. The window is what both images can see of the depths of `points` (N, 3), local frame: robust
    extremes and a margin, and surfaces that come nearer by the factor `nearer` >= 1.
    """
    baseline = local_from_right.translation - local_from_left.translation
    length = float(np.linalg.norm(baseline))
    axes = np.stack([local_from_left.rotation[:, 2], local_from_right.rotation[:, 2]])
    if length <= 0.0 or np.abs(axes @ baseline).max() > MAX_AXIS_COSINE * length:
        return None
    x = baseline / length
    z = axes.sum(axis=0)
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    rect_from_local = np.stack([x, np.cross(z, x), z])

    depths = (points - local_from_left.translation) @ z
    depths = depths[depths > 0.0]
    if len(depths) == 0:
        return None
    low, high = np.percentile(focal_px * length / depths, [1.0, 99.0])
    widening = RANGE_MARGIN * (high - low) + 0.02 * high
    low, high = max(low - widening, 0.0), max(nearer * high, high + widening)
    disparities = int(np.ceil((high - low) / DISPARITY_STEP)) * DISPARITY_STEP

    rect_from_left = rect_from_local @ local_from_left.rotation
    rect_from_right = rect_from_local @ local_from_right.rotation
    left_window = _window(left, rect_from_left, focal_px)
    right_window = _window(right, rect_from_right, focal_px)
    if left_window is None or right_window is None:
        return None
    top, bottom = max(left_window[1], right_window[1]), min(left_window[3], right_window[3])
    begin = max(left_window[0], right_window[0] + low) - disparities  # SGBM leaves so many columns out
    end = min(left_window[2], right_window[2] + high)
    width, height = (2 * int(np.ceil(max(side, 0.0) / 2)) for side in (end - begin, bottom - top))
    if width <= disparities or not 0 < width * height < MAX_PIXELS * left.width * left.height:
        return None
    return Rectification(
        rect_from_left, rect_from_right, focal_px, length, (-begin, -top), float(low), disparities, width, height
    )


def _window(camera: Camera, rect_from_cam: Float, focal_px: float) -> tuple[float, float, float, float] | None:
    """Return left, top, right, bottom of an image in rectified pixels about the principal point."""
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    zero, one = np.zeros_like(along), np.ones_like(along)
    border = np.concatenate(
        [np.stack(side, axis=-1) for side in ((along, zero), (along, one), (zero, along), (one, along))]
    )
    rays = camera.rays(border * (camera.width, camera.height)) @ rect_from_cam.T
    if rays[:, 2].min() < 0.1:
        return None
    xy = focal_px * rays[:, :2] / rays[:, 2:]
    (left, top), (right, bottom) = xy.min(axis=0), xy.max(axis=0)
    return float(left), float(top), float(right), float(bottom)
