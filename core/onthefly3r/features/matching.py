"""Verified matches of image pairs: a few features tell how two images lie to each other, the rest is looked up.

The features that come first are spread over the image: their mutual neighbours give the epipolar geometry. All
features are then compared within their epipolar planes alone, which costs less than comparing each with each, and
finds more. Descriptors hold whole numbers, so their products are exact, whatever the number of threads.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..geometry.arrays import Bool, Float, Int
from ..geometry.camera import Camera
from ..records import Features
from .epipolar import guided_neighbours, relative_geometry
from .rootsift import NORM

CACHED_PAIRS = 4000
FIRST_FEATURES = 1000
MAX_RATIO = 0.8
MAX_DISTANCE = 0.7
MIN_INLIERS = 15
# Inliers among the first features: with fewer, all features are compared with all, unless so few of the first ones
# match at all that the images cannot overlap.
WEAK_PAIR, MIN_HINTS = 30, 8
MAX_MATCHES = 300  # of a pair
# How far a match may lie from its epipolar line. A focal length that is only a prior bends the lines: a narrow band
# would keep what agrees with the wrong one.
BAND_PX, PRIOR_BAND_PX = 1.0, 3.0
SCALE_FACTOR, TURN_RAD = 1.5, 0.6  # from how the pair's features usually change scale and turn


_Known = tuple[Camera, Camera, bool]  # cameras of a pair when it was matched, and whether both were calibrated


class PairMatcher:
    """Verified matches by image pair; a pair that two subsets share is matched once, and anew with better cameras.

    So its matches tell of nothing but features and cameras, whichever subsets came before.
    A thorough one compares all features of every pair with all, and keeps twice as many matches.
    """

    def __init__(self, threads: int, thorough: bool = False) -> None:
        self._threads = threads
        self._thorough = thorough
        self._recent: OrderedDict[tuple[int, int], tuple[_Known, Int]] = OrderedDict()

    def match(
        self,
        features: Mapping[int, Features],
        cameras: Mapping[int, Camera],
        calibrated: Mapping[int, bool],
        members: Sequence[int],
        checkpoint: Callable[[], None] = lambda: None,
    ) -> dict[tuple[int, int], Int]:
        """Return the verified matches (M, 2) of all pairs (i < j) of the members, rows of their features.

        `calibrated` tells whose camera is more than a prior. A pair that fails has no matches. `checkpoint` is called
        between pairs; what it raises ends the work.
        """
        pairs = [(min(p), max(p)) for p in itertools.combinations(members, 2)]
        known: dict[tuple[int, int], _Known] = {
            (i, j): (cameras[i], cameras[j], calibrated[i] and calibrated[j]) for i, j in pairs
        }
        missing = [pair for pair in pairs if pair not in self._recent or self._recent[pair][0] != known[pair]]
        sides = {i: Side(features[i], cameras[i]) for i in sorted({i for pair in missing for i in pair})}
        with ThreadPoolExecutor(self._threads) as pool:
            found = pool.map(
                lambda pair: verified_matches(
                    sides[pair[0]],
                    sides[pair[1]],
                    BAND_PX if known[pair][2] else PRIOR_BAND_PX,
                    self._thorough,
                ),
                missing,
            )
            try:
                for pair, verified in zip(missing, found, strict=True):
                    self._recent[pair] = known[pair], verified
                    checkpoint()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # else the end of `with` waits for all pairs
                raise
        matches = {}
        for pair in pairs:
            self._recent.move_to_end(pair)
            matches[pair] = self._recent[pair][1]
        while len(self._recent) > max(CACHED_PAIRS, len(pairs)):
            self._recent.popitem(last=False)
        return matches


class Side:
    """One image of pairs: its features with what all its pairs need of them."""

    def __init__(self, features: Features, camera: Camera) -> None:
        self.features = features
        self.rays = camera.rays(features.pixels)  # (N, 3), z = 1
        self.focal_px = float(np.sqrt(camera.fx * camera.fy))
        self.vectors = features.descriptors.astype(np.float32)  # (N, 128), whole numbers


def verified_matches(first: Side, second: Side, band_px: float, thorough: bool = False) -> Int:
    """Return up to `MAX_MATCHES` matches (M, 2) that agree on an epipolar geometry, best spread first; or none.

    A thorough comparison takes all features from the start, and returns up to twice as many.
    """
    focal_px = 0.5 * (first.focal_px + second.focal_px)
    few = slice(None if thorough else FIRST_FEATURES)
    some = _mutual(first.vectors[few], second.vectors[few])
    geometry = relative_geometry(first.rays[some[:, 0]], second.rays[some[:, 1]], focal_px, band_px, MIN_INLIERS)
    if geometry is None or np.count_nonzero(geometry.inliers) < WEAK_PAIR:
        if not thorough and len(some) >= MIN_HINTS and max(len(first.vectors), len(second.vectors)) > FIRST_FEATURES:
            every = _mutual(first.vectors, second.vectors)
            more = relative_geometry(first.rays[every[:, 0]], second.rays[every[:, 1]], focal_px, band_px, MIN_INLIERS)
            if more is not None:
                some, geometry = every, more
        if geometry is None:
            return np.zeros((0, 2), np.int64)
    sure = some[geometry.inliers]
    guided = guided_neighbours(
        geometry.matrix, first.rays, second.rays, first.vectors, second.vectors, band_px / focal_px
    )
    found = _accepted(*guided)
    found = found[_alike(first.features, second.features, sure, found)]
    if len(found) < len(sure):
        found = sure
    # Features come best spread first: so do pairs of them, and the pairs of an image agree on which to keep.
    return found[np.argsort(found.max(axis=1), kind="stable")[: MAX_MATCHES * (2 if thorough else 1)]]


def mutual_matches(first: Features, second: Features) -> Int:
    """Return index pairs (M, 2) of mutual nearest RootSIFT neighbours that pass Lowe's ratio test."""
    return _mutual(first.descriptors.astype(np.float32), second.descriptors.astype(np.float32))


def _mutual(first: Float, second: Float) -> Int:
    if not len(first) or not len(second):
        return np.zeros((0, 2), np.int64)
    # One matrix product finds all distances: an order faster than building an index for a few thousand features.
    similarity = first @ second.T
    best = similarity.argmax(axis=1)
    rows = np.arange(len(best))
    nearest = similarity[rows, best]
    # The maximum of a column is an order cheaper than where it is.
    candidates = np.flatnonzero(nearest >= similarity.max(axis=0)[best])
    runner_up = np.full(len(best), np.inf, np.float32)
    contested = similarity[candidates]
    contested[np.arange(len(candidates)), best[candidates]] = -1.0
    runner_up[candidates] = contested.max(axis=1)
    return _accepted(rows, best, nearest, runner_up)


def _accepted(rows: Int, best: Int, nearest: Float, runner_up: Float) -> Int:
    """Return the pairs that are near enough and clearly nearer than the runner-up; of equal ones the first counts."""
    distance, second_distance = _squared_distance(nearest), _squared_distance(runner_up)
    good = np.flatnonzero((distance < MAX_RATIO**2 * second_distance) & (distance < MAX_DISTANCE**2))
    good = good[np.unique(best[good], return_index=True)[1]]
    return np.column_stack([rows[good], best[good]])


def _squared_distance(product: Float) -> Float:
    return np.asarray(np.maximum(2.0 - 2.0 * product / NORM**2, 0.0))


def _alike(first: Features, second: Features, sure: Int, matches: Int) -> Bool:
    """Return which matches change scale and turn as the sure ones do."""

    def change(pairs: Int) -> tuple[Float, Float]:
        scale = np.log(first.scales[pairs[:, 0]] / second.scales[pairs[:, 1]])
        return scale, first.angles[pairs[:, 0]] - second.angles[pairs[:, 1]]

    usual_scale, usual_turn = change(sure)
    scale, turn = change(matches)
    mean_turn = np.angle(np.exp(1j * usual_turn).sum())
    off = np.abs((turn - mean_turn + np.pi) % (2.0 * np.pi) - np.pi)
    return np.asarray((np.abs(scale - np.median(usual_scale)) < np.log(SCALE_FACTOR)) & (off < TURN_RAD))
