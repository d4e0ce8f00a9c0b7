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
JUMP_PX = 5  # window at half size in which a jump of the disparity makes a pixel doubtful,
SLOPE_PX = 1.0  # where it is larger than this,
JUMP_SHARE = 0.1  # by this part of it
MIN_CORRELATION = 0.5  # of the two windows
MAX_SHIFT_PX = 1.5  # a refinement that moves farther has left the match it started from


def disparity(left: UInt8, right: UInt8, disparities: int) -> tuple[Float, Float]:
    """Return the disparities (H, W) float32 of the left image in px, NaN where unknown, and their standard deviations.

    left, right: (H, W) of even sides, 0 outside of the image; the same point lies in the same row, and
    x_left - x_right is from 0 to `disparities`.
    Hirschmueller 2008 (OpenCV's StereoSGBM, with its left-right check); least-squares matching: Lucas & Kanade 1981.
    """
    import cv2

    half = (left.shape[1] // 2, left.shape[0] // 2)
    small = [cv2.resize(image, half, interpolation=cv2.INTER_AREA) for image in (left, right)]
    coarse = _semi_global(small[0], small[1], disparities // 2)
    start = 2.0 * cv2.resize(coarse, left.shape[::-1], interpolation=cv2.INTER_NEAREST)
    linear = 2.0 * cv2.resize(coarse, left.shape[::-1], interpolation=cv2.INTER_LINEAR)
    smooth = np.abs(linear - start) < 1.0  # False at NaN
    found, sigma = _least_squares(left, right, np.where(smooth, linear, start))
    jump = 2.0 * cv2.resize(_jump(coarse), left.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return found, np.hypot(sigma, np.float32(JUMP_SHARE) * jump)


def _semi_global(left: UInt8, right: UInt8, disparities: int) -> Float:
    import cv2

    matcher = cv2.StereoSGBM.create(
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


def _jump(found: Float) -> Float:
    """Return by how much the disparities about a pixel differ beyond those of a slope: it may belong to either side."""
    import cv2

    block = np.ones((JUMP_PX, JUMP_PX), np.uint8)
    known = np.isfinite(found)
    high = cv2.dilate(np.where(known, found, np.float32(-1e3)), block)
    low = cv2.erode(np.where(known, found, np.float32(1e4)), block)
    return np.where(known, np.maximum(high - low - np.float32(SLOPE_PX), np.float32(0.0)), np.float32(0.0))


def _least_squares(left: UInt8, right: UInt8, start: Float) -> tuple[Float, Float]:
    """Shift each window of the right image along its row until it fits the left one best."""
    import cv2

    rows, columns = left.shape
    x = np.arange(columns, dtype=np.float32)[None, :]
    y = np.repeat(np.arange(rows, dtype=np.float32)[:, None], columns, axis=1)
    known = np.isfinite(start) & (_inside(left) > 0)
    start = np.where(known, start, np.float32(0.0))
    known &= cv2.remap(_inside(right), x - start, y, cv2.INTER_NEAREST) > 0
    weight = known.astype(np.float32)

    first, second = _normalised(left), _normalised(right)
    gradient = cv2.Sobel(first, cv2.CV_32F, 1, 0, ksize=3, scale=0.125) * weight
    window = (WINDOW_PX, WINDOW_PX)
    information = np.maximum(cv2.blur(gradient * gradient, window), 1e-4)
    # One step is enough from the start that semi-global matching gives; a second one gains nothing.
    difference = (first - cv2.remap(second, x - start, y, cv2.INTER_LINEAR)) * weight
    shift = cv2.blur(gradient * difference, window) / information
    residual = cv2.blur(difference * difference, window) - shift * shift * information  # after the shift
    variance = np.maximum(residual, np.float32(0.0)) / np.maximum(cv2.blur(weight, window), np.float32(1e-4))
    correlation = 1.0 - 0.5 * residual / np.maximum(cv2.blur(first * first * weight, window), np.float32(1e-4))
    lost = ~known | (np.abs(shift) > MAX_SHIFT_PX) | (correlation < MIN_CORRELATION)
    # The formal error knows only noise; windows that look different may be no match at all.
    sigma = np.sqrt(variance / information) / (WINDOW_PX * np.maximum(correlation, np.float32(MIN_CORRELATION)) ** 2)
    return np.where(lost, np.float32(np.nan), start - shift), sigma


def _inside(image: UInt8) -> UInt8:
    """Return 1 where a block about the pixel lies within the image, 0 elsewhere."""
    import cv2

    block = np.ones((2 * BLOCK_PX, 2 * BLOCK_PX), np.uint8)
    return np.asarray(cv2.erode(cv2.min(image, 1), block, borderType=cv2.BORDER_CONSTANT, borderValue=0))


def _normalised(image: UInt8) -> Float:
    """Return the image with local mean 0 and local contrast 1 where it has any."""
    import cv2

    window = (CONTRAST_PX, CONTRAST_PX)
    share = np.maximum(cv2.boxFilter(cv2.min(image, 1), cv2.CV_32F, window), np.float32(0.01))
    mean = cv2.boxFilter(image, cv2.CV_32F, window) / share
    variance = cv2.sqrBoxFilter(image, cv2.CV_32F, window) / share - mean * mean
    return np.asarray((image - mean) / np.sqrt(np.maximum(variance, np.float32(0.0)) + np.float32(NOISE_GREY**2)))
