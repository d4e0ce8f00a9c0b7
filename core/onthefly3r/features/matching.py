"""Pairwise matching and geometric verification of the images of one subset."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ..geometry.arrays import Float, Int
from ..geometry.camera import Camera
from ..records import Features
from .pycolmap_module import load_pycolmap

CACHED_PAIRS = 4000
DESCRIPTOR_NORM = 512.0  # pycolmap stores unit RootSIFT vectors times 512 as bytes
MAX_RATIO = 0.8
MAX_DISTANCE = 0.7
MIN_TRIALS = 30  # of RANSAC; most pairs of a subset have so many inliers that these suffice


class PairMatcher:
    """Verified two-view geometries by image pair; a pair that two subsets share is matched once."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._recent: OrderedDict[tuple[int, int], Any] = OrderedDict()

    def match(
        self,
        features: Mapping[int, Features],
        cameras: Mapping[int, Camera],
        members: Sequence[int],
        checkpoint: Callable[[], None] = lambda: None,
    ) -> dict[tuple[int, int], Any]:
        """Return pycolmap two-view geometries of all pairs (i < j) of the members, indices into their features.

        `checkpoint` is called between pairs; what it raises ends the work.
        """
        pairs = [(min(p), max(p)) for p in itertools.combinations(members, 2)]
        missing = [pair for pair in pairs if pair not in self._recent]
        made = {i: to_pycolmap_camera(cameras[i], 1) for i in members}
        with ThreadPoolExecutor(self._threads) as pool:
            geometries = pool.map(
                lambda pair: self._match_pair(features[pair[0]], made[pair[0]], features[pair[1]], made[pair[1]]),
                missing,
            )
            try:
                for pair, geometry in zip(missing, geometries, strict=True):
                    self._recent[pair] = geometry
                    checkpoint()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # else the end of `with` waits for all pairs
                raise
        found = {}
        for pair in pairs:
            self._recent.move_to_end(pair)
            found[pair] = self._recent[pair]
        while len(self._recent) > max(CACHED_PAIRS, len(pairs)):
            self._recent.popitem(last=False)
        return found

    @staticmethod
    def _match_pair(first: Features, camera1: Any, second: Features, camera2: Any) -> Any:
        pycolmap = load_pycolmap()

        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        options.ransac.min_num_trials = MIN_TRIALS
        options.detect_watermark = False
        matches = mutual_matches(first, second)
        if len(matches) < options.min_num_inliers:
            return pycolmap.TwoViewGeometry()
        return pycolmap.estimate_two_view_geometry(
            camera1, first.pixels.astype(np.float64), camera2, second.pixels.astype(np.float64), matches, options
        )


def mutual_matches(first: Features, second: Features) -> Int:
    """Return index pairs (M, 2) of mutual nearest RootSIFT neighbours that pass Lowe's ratio test."""
    if not len(first.descriptors) or not len(second.descriptors):
        return np.zeros((0, 2), np.uint32)
    # One matrix product finds all distances: an order faster than building an index for a few thousand features.
    similarity = first.descriptors.astype(np.float32) @ second.descriptors.astype(np.float32).T
    best = similarity.argmax(axis=1)
    nearest = similarity[np.arange(len(best)), best]
    # The maximum of a column is an order cheaper than where it is; of equal features the first one counts.
    candidates = np.flatnonzero(nearest >= similarity.max(axis=0)[best])
    rows = candidates[np.unique(best[candidates], return_index=True)[1]]
    similarity[np.arange(len(best)), best] = -1.0
    distance, second_distance = _distance(nearest[rows]), _distance(similarity.max(axis=1)[rows])
    good = (distance < MAX_RATIO * second_distance) & (distance < MAX_DISTANCE)
    return np.column_stack([rows[good], best[rows[good]]]).astype(np.uint32)


def _distance(product: Float) -> Float:
    return np.asarray(np.sqrt(np.maximum(2.0 - 2.0 * product / DESCRIPTOR_NORM**2, 0.0)))


def to_pycolmap_camera(camera: Camera, camera_id: int) -> Any:
    """Return the camera as pycolmap's OPENCV model, its focal length marked as known."""
    pycolmap = load_pycolmap()

    made = pycolmap.Camera(
        model="OPENCV",
        width=camera.width,
        height=camera.height,
        params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
        camera_id=camera_id,
    )
    made.has_prior_focal_length = True
    return made
