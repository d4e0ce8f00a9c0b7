"""Disparities of a rectified pair: semi-global matching at half size, then least squares at full size."""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float, UInt8

BLOCK_PX = 5
UNIQUENESS_PERCENT = 5
SPECKLE_PX, SPECKLE_RANGE = 120, 1
CONTRAST_PX = 15  # window over which brightness and contrast are made equal
NOISE_GREY = 3.0  # contrasts below this are noise
WINDOW_PX = 9  # of the least squares
STEPS = 2
MAX_SHIFT_PX = 1.5  # a refinement that moves farther has left the match it started from


def disparity(left: UInt8, right: UInt8, disparities: int) -> tuple[Float, Float]:
    """Return the disparities (H, W) float32 of the left image in px, NaN where unknown, and their standard deviations.

    left, right: (H, W) of even sides, the same point in the same row, x_left - x_right from 0 to `disparities`.
    Hirschmueller 2008 (OpenCV's StereoSGBM, with its left-right check); least-squares matching: Lucas & Kanade 1981.
    """
    import cv2

    half = (left.shape[1] // 2, left.shape[0] // 2)
    small = [cv2.resize(image, half, interpolation=cv2.INTER_AREA) for image in (left, right)]
    coarse = _semi_global(small[0], small[1], disparities // 2)
    start = 2.0 * cv2.resize(coarse, left.shape[::-1], interpolation=cv2.INTER_NEAREST)
    linear = 2.0 * cv2.resize(coarse, left.shape[::-1], interpolation=cv2.INTER_LINEAR)
    smooth = np.abs(linear - start) < 1.0  # False at NaN
    return _least_squares(left, right, np.where(smooth, linear, start))


def _semi_global(left: UInt8, right: UInt8, disparities: int) -> Float:
    import cv2

    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=UNIQUENESS_PERCENT,
        speckleWindowSize=SPECKLE_PX,
        speckleRange=SPECKLE_RANGE,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(left, right).astype(np.float32) / 16.0
    invalid = found < 0.0
    found[invalid] = -10.0  # so far off that the filter does not mix it in
    found = cv2.bilateralFilter(found, 7, 0.7, 2.0)
    found[invalid] = np.nan
    return np.asarray(found)


def _least_squares(left: UInt8, right: UInt8, start: Float) -> tuple[Float, Float]:
    """Shift each window of the right image along its row until it fits the left one best."""
    import cv2

    first, second = _normalised(left), _normalised(right)
    gradient = cv2.Sobel(first, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    rows, columns = left.shape
    x = np.arange(columns, dtype=np.float32)[None, :]
    y = np.repeat(np.arange(rows, dtype=np.float32)[:, None], columns, axis=1)
    known = np.isfinite(start)
    weight = known.astype(np.float32)
    start = np.where(known, start, 0.0).astype(np.float32)
    window = (WINDOW_PX, WINDOW_PX)
    information = cv2.blur(gradient * gradient * weight, window) + 1e-4
    found = start
    for _ in range(STEPS):
        warped = cv2.remap(second, x - found, y, cv2.INTER_LINEAR)
        difference = (first - warped) * weight
        found = found + cv2.blur(gradient * difference, window) / information * -1.0
    share = cv2.blur(weight, window) + 1e-4
    variance = cv2.blur(difference * difference, window) / share
    sigma = np.sqrt(np.maximum(variance, 0.0) / np.maximum(information, 1e-4)) / WINDOW_PX
    lost = ~known | (np.abs(found - start) > MAX_SHIFT_PX)
    found[lost] = np.nan
    return found, np.asarray(sigma, np.float32)


def _normalised(image: UInt8) -> Float:
    """Return the image with local mean 0 and local contrast 1 where it has any."""
    import cv2

    grey = image.astype(np.float32)
    window = (CONTRAST_PX, CONTRAST_PX)
    mean = cv2.blur(grey, window)
    variance = cv2.blur(grey * grey, window) - mean * mean
    return np.asarray((grey - mean) / np.sqrt(np.maximum(variance, 0.0) + NOISE_GREY**2))
