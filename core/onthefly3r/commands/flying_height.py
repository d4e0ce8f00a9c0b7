"""Flying height above ground from a few pairs of photographs, for drones that do not state it.

Between two photographs the ground moves through the image by focal length times baseline over height: the baseline is
known from the positions, the shift from matched features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ..errors import PhotographError
from ..features.extraction import extract_features
from ..features.matching import mutual_matches
from ..geometry.arrays import Float
from ..intake.images import load_working_image
from ..records import Shot

MOST_PAIRS, LEAST_PAIRS = 8, 3
WORKING_PX, FEATURES = 600, 1500
LEAST_MATCHES = 30
LEAST_SHIFT = 0.02  # of the image's width: less tells more about the receiver's noise than about the height
MOST_SPREAD = 0.5  # of the heights of the pairs about their median


def measured_height_m(shots: Sequence[Shot], places: Mapping[int, Float]) -> float | None:
    """Return the flight's median height above ground, m; None where the pairs tell none or contradict each other.

    Args:
        shots: in capture order.
        places: positions (3,) in m by index of shot, in any level frame.
    """
    heights = []
    for first, second in _pairs(shots, places):
        baseline_m = float(np.linalg.norm(places[second][:2] - places[first][:2]))
        shift = _shift(shots[first], shots[second])
        if shift is not None and shift > LEAST_SHIFT:
            heights.append(shots[first].focal_ratio * baseline_m / shift)
    if len(heights) < LEAST_PAIRS:
        return None
    height_m = float(np.median(heights))
    spread = float(np.median(np.abs(np.array(heights) - height_m))) / height_m
    return height_m if spread < MOST_SPREAD else None


def _pairs(shots: Sequence[Shot], places: Mapping[int, Float]) -> list[tuple[int, int]]:
    """Return consecutive photographs of one camera that are apart, spread over the flight."""
    known = sorted(places)
    pairs = [
        (a, b)
        for a, b in pairwise(known)
        if shots[a].camera_key == shots[b].camera_key and np.linalg.norm(places[b][:2] - places[a][:2]) > 1.0
    ]
    return pairs[:: max(1, len(pairs) // MOST_PAIRS)][:MOST_PAIRS]


def _shift(first: Shot, second: Shot) -> float | None:
    """Return how far the middle of the first photograph moves in the second, in image widths (longest side)."""
    import cv2

    try:
        images = [load_working_image(shot, WORKING_PX).rgb for shot in (first, second)]
    except PhotographError:
        return None
    seen = extract_features(images, FEATURES, threads=2)
    matches = mutual_matches(*seen)
    if len(matches) < LEAST_MATCHES:
        return None
    here, there = seen[0].pixels[matches[:, 0]], seen[1].pixels[matches[:, 1]]
    similarity, inliers = cv2.estimateAffinePartial2D(here, there, ransacReprojThreshold=8.0)
    if similarity is None or int(inliers.sum()) < LEAST_MATCHES // 2:
        return None
    height_px, width_px = images[0].shape[:2]
    middle = np.array([width_px / 2.0, height_px / 2.0])
    moved = similarity[:, :2] @ middle + similarity[:, 2] - middle
    return float(np.linalg.norm(moved) / max(width_px, height_px))
