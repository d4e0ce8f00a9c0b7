"""RootSIFT descriptors of keypoints (Lowe 2004; Arandjelovic & Zisserman 2012), for many keypoints at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from ..geometry.arrays import Float, UInt8
from .keypoints import SIGMA, STEP, Keypoints, Octave

NORM = 512.0  # descriptors are unit vectors times this, as bytes
DIRECTIONS = 36  # bins of the histogram that tells the orientation
ORIENTATION_SIGMAS, ORIENTATION_SAMPLES = 3.5, 12  # half width of its window in blurs, samples per side
ORIENTATION_WEIGHT = 1.8  # standard deviation of its weights, in blurs
GRID, BINS = 4, 8  # cells per side and directions of the descriptor
CELL_SIGMAS = 3.0  # width of a cell in blurs
WINDOW_SAMPLES = 16  # per side
CLIPPED = 0.2  # of a unit vector
AT_ONCE = 256  # keypoints, so that what is worked on stays in the processor's cache


def describe(octaves: Sequence[Octave], keypoints: Keypoints) -> tuple[Float, UInt8]:
    """Return the orientations (N,) float32 in rad and the descriptors (N, 128) of keypoints."""
    import cv2

    angles = np.zeros(len(keypoints.octave), np.float32)
    descriptors = np.zeros((len(keypoints.octave), GRID * GRID * BINS), np.uint8)
    for number, octave in enumerate(octaves):
        own = keypoints.of_octave(number)
        for level in np.unique(keypoints.level[own]):
            rows = own[keypoints.level[own] == level]
            image = octave.levels[level]
            slopes = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=1), cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=1)
            sigma = float(SIGMA * STEP**level)
            for start in range(0, len(rows), AT_ONCE):
                part = rows[start : start + AT_ONCE]
                angles[part] = _orientations(slopes, keypoints.xy[part], sigma)
                descriptors[part] = _descriptors(slopes, keypoints.xy[part], sigma, angles[part])
    return angles, descriptors


def _orientations(slopes: tuple[Float, Float], xy: Float, sigma: float) -> Float:
    """Return the directions (N,) in which the image brightens most about the keypoints."""
    offsets, weight = _orientation_window()
    places = xy[:, None] + np.float32(sigma) * offsets
    strength, direction = _polar(slopes, places)
    count = len(xy)
    bins = np.rint(direction * np.float32(DIRECTIONS / (2.0 * np.pi))).astype(np.int64) % DIRECTIONS
    bins += DIRECTIONS * np.arange(count)[:, None]
    votes = np.bincount(bins.ravel(), (strength * weight).ravel(), DIRECTIONS * count).reshape(count, DIRECTIONS)
    smooth = 6.0 * votes
    for by, share in ((1, 4.0), (2, 1.0)):
        smooth += share * (np.roll(votes, by, axis=1) + np.roll(votes, -by, axis=1))
    rows, peak = np.arange(count), smooth.argmax(axis=1)
    before, here, after = smooth[rows, peak - 1], smooth[rows, peak], smooth[rows, (peak + 1) % DIRECTIONS]
    curvature = np.minimum(before - 2.0 * here + after, -1e-12)
    return np.asarray((peak + 0.5 * (before - after) / curvature) * (2.0 * np.pi / DIRECTIONS), np.float32)


def _descriptors(slopes: tuple[Float, Float], xy: Float, sigma: float, angles: Float) -> UInt8:
    offsets, pooling = _descriptor_window()
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    turned = np.stack(
        [cosine * offsets[:, 0] - sine * offsets[:, 1], sine * offsets[:, 0] + cosine * offsets[:, 1]], axis=-1
    )
    strength, direction = _polar(slopes, xy[:, None] + np.float32(CELL_SIGMAS * sigma) * turned)
    place = (direction - angles[:, None]) * np.float32(BINS / (2.0 * np.pi)) + np.float32(2 * BINS)
    lower = place.astype(np.int32)
    share = (place - lower) * strength
    # Every sample votes for the two directions next to its own.
    votes = np.zeros(strength.size * BINS, np.float32)
    sample = np.arange(0, len(votes), BINS).reshape(lower.shape)
    votes[sample + lower % BINS] = strength - share
    votes[sample + (lower + 1) % BINS] = share
    vectors = np.matmul(pooling, votes.reshape(len(xy), len(offsets), BINS)).reshape(len(xy), -1)
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.float32(1e-9))
    np.minimum(vectors, np.float32(CLIPPED), out=vectors)
    vectors /= np.maximum(vectors.sum(axis=1, keepdims=True), np.float32(1e-9))
    return np.asarray(np.rint(np.sqrt(vectors) * np.float32(NORM)).clip(0, 255), np.uint8)


def _polar(slopes: tuple[Float, Float], places: Float) -> tuple[Float, Float]:
    """Return length and direction (rad, 0 to 2 pi) of the gradient at places (N, M, 2) of an octave."""
    import cv2

    # One by one: OpenCV takes ten times as long for an image of two channels as for one of one.
    across, down = (cv2.remap(slope, places, None, cv2.INTER_LINEAR) for slope in slopes)
    strength, direction = cv2.cartToPolar(across, down)
    return np.asarray(strength), np.asarray(direction)


@lru_cache(maxsize=1)
def _orientation_window() -> tuple[Float, Float]:
    """Return the samples (M, 2) in blurs, and their weights (M,)."""
    along = np.linspace(-ORIENTATION_SIGMAS, ORIENTATION_SIGMAS, ORIENTATION_SAMPLES)
    offsets = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * (offsets**2).sum(axis=1) / ORIENTATION_WEIGHT**2)
    return offsets.astype(np.float32), weight.astype(np.float32)


@lru_cache(maxsize=1)
def _descriptor_window() -> tuple[Float, Float]:
    """Return the samples (M, 2) in cells, and how much each counts in each cell (cells, M): Gaussian times bilinear."""
    half = 0.5 * (GRID + 1)  # a cell's samples reach to its neighbours' centres
    along = (np.arange(WINDOW_SAMPLES) + 0.5) / WINDOW_SAMPLES * 2.0 * half - half
    centres = np.arange(GRID) - 0.5 * (GRID - 1)
    near = np.maximum(0.0, 1.0 - np.abs(along[:, None] - centres))  # (samples, cells)
    gauss = np.exp(-0.5 * (along / (0.5 * GRID)) ** 2)
    one = near * gauss[:, None]
    pooling = np.einsum("ya,xb->abyx", one, one).reshape(GRID * GRID, -1)
    offsets = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return offsets.astype(np.float32), pooling.astype(np.float32)
