"""The depth map of one photograph with final cameras: rectified stereo with its best partners among all placed ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..backbones.dense import PosedImage, merge_depths, pair_depth
from ..geometry.arrays import Float, UInt8
from ..intake.images import load_working_image
from .views import View

PARTNERS = 4
DISPUTED = 0.3  # trust of a depth that the partners contradict is below this


def stereo_depth(view: View, partners: Sequence[View], grey: Callable[[View], UInt8]) -> tuple[Float, Float]:
    """Return depths and their standard deviations (H, W) float32 in the view's grid, 0 where nothing is known.

    Args:
        view: whose depths are wanted.
        partners: best first.
        grey: gives the grey image of a view, at the size of its camera.
    """
    left = _posed(view, grey)
    found = [
        measured
        for partner in partners
        if (measured := pair_depth(left, _posed(partner, grey), view.points, view.grid)) is not None
    ]
    if not found:
        nothing = np.zeros((view.grid.height, view.grid.width), np.float32)
        return nothing, nothing
    merged = merge_depths([depth for depth, _ in found], [sigma for _, sigma in found], view.grid.fx)
    known = np.isfinite(merged.depth) & (merged.depth > 0.0) & (merged.trust > DISPUTED)
    return (
        np.where(known, merged.depth, np.float32(0.0)).astype(np.float32),
        np.where(known, merged.sigma, np.float32(0.0)).astype(np.float32),
    )


def pictures(view: View) -> tuple[UInt8, UInt8]:
    """Return the grey photograph (h, w) as its camera sees it, and its colours (H, W, 3) as the grid sees them.

    Raises `PhotographError` where the file can no longer be read.
    """
    import cv2

    rgb = load_working_image(view.shot, max(view.camera.width, view.camera.height)).rgb
    if rgb.shape[:2] != (view.camera.height, view.camera.width):  # of an adapter that rounds sides otherwise
        rgb = np.asarray(cv2.resize(rgb, (view.camera.width, view.camera.height), interpolation=cv2.INTER_AREA))
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    if view.grid == view.camera:
        return grey, rgb
    given, wanted = (camera.matrix() - _HALF_PIXEL for camera in (view.camera, view.grid))
    size = view.grid.width, view.grid.height
    maps = cv2.initUndistortRectifyMap(given, np.array(view.camera.distortion), np.eye(3), wanted, size, cv2.CV_16SC2)
    return grey, np.asarray(cv2.remap(rgb, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


_HALF_PIXEL = np.array(
    [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]
)  # OpenCV counts from the first pixel's centre


def _posed(view: View, grey: Callable[[View], UInt8]) -> PosedImage:
    return PosedImage(grey(view), view.camera, view.level_from_cam)
