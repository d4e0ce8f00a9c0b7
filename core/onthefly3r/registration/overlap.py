"""Whether two fragments of a map agree where a join would lay them over each other: in depth and in looks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..geometry.arrays import Bool, Float
from ..geometry.transforms import Sim3
from ..records import PlacedMap
from .validate import DEPTH_TOLERANCE, MIN_AGREEING_SHARE, MIN_OVERLAP_POINTS

SAMPLED_POINTS = 100  # of a frame
NEAREST_VIEWS = 4  # of the other fragment that a frame is compared with,
VIEWS_WITHIN = 10  # and of its own
SHARED = 0.3  # of a frame's points that another must have in its picture to be expected to look like it
SIMILAR_SHARE = 0.1  # pairs that share as much, give or take this, are compared
MIN_PAIRS = 8
CLOSE = 1.0 / 24.0  # of the picture's width: stored points that near to a pixel tell its depth
MIN_AGREEING_FRAMES = 0.75
MAX_UNLIKE = 0.4  # of the pairs across that may look like unrelated pictures
MAX_FRAMES = 60  # that are looked at


@dataclass(frozen=True)
class OverlapVerdict:
    """The outcome of the check; an empty reason means passed."""

    reason: str
    numbers: dict[str, float] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the join."""
        return not self.reason


Similar = Callable[[Sequence[int], Sequence[int]], Float]


def check_overlap(source: PlacedMap, into: PlacedMap, into_from_source: Sim3, similarities: Similar) -> OverlapVerdict:
    """Compare two fragments in all that they would see in common.

    The points that a frame predicted must lie as deep in the frames of the other fragment as these have it, and
    frames that see the same ground must look as much alike as those within a fragment that share as much: blocks that
    are merely like each other differ in both beyond their edges.

    Args:
        source: the fragment that would be moved.
        into: the one that stays.
        into_from_source: the join.
        similarities: (first, second) -> similarities of all pairs of frames.
    """
    across = [max(pairs, key=lambda pair: pair.shared) for pairs in _seen(source, into, into_from_source)]
    across = [pair for pair in across if pair.shared * SAMPLED_POINTS >= MIN_OVERLAP_POINTS]
    if not across:
        return OverlapVerdict("they would not overlap")
    depths = [_agreeing(pair, source, into, into_from_source) for pair in across]
    known = [share for share in depths if np.isfinite(share)]
    agreeing = float(np.mean(np.array(known) >= MIN_AGREEING_SHARE)) if known else 1.0
    numbers = {"overlapping_frames": float(len(across)), "agreeing_frames": agreeing}
    if agreeing < MIN_AGREEING_FRAMES:
        return OverlapVerdict("their depths disagree where they overlap", numbers)
    unlike = _unlike(
        across, [pair for part in (source, into) for pairs in _seen(part, part) for pair in pairs], similarities
    )
    if unlike is not None:
        numbers["unlike_frames"] = unlike
        if unlike > MAX_UNLIKE:
            return OverlapVerdict("what would lie on each other does not look alike", numbers)
    return OverlapVerdict("", numbers)


@dataclass(frozen=True)
class _Pair:
    frame: int
    other: int
    shared: float  # share of the frame's points that the other has in its picture


def _seen(source: PlacedMap, into: PlacedMap, into_from_source: Sim3 | None = None) -> list[list[_Pair]]:
    """Return, for frames spread over `source`, how much the nearest frames of `into` see of what they see."""
    others, own = list(into.frames), list(source.frames)
    centres = np.array([into.map_from_cam(i).translation for i in others])
    change, count = (into_from_source, NEAREST_VIEWS) if into_from_source is not None else (Sim3(), VIEWS_WITHIN)
    found = []
    for index in (own[k] for k in np.unique(np.linspace(0, len(own) - 1, MAX_FRAMES).astype(int))):
        points = change.apply(_sample(source, index))
        if not len(points):
            continue
        away = np.linalg.norm(centres - change.apply(source.map_from_cam(index).translation), axis=1)
        nearest = [others[k] for k in np.argsort(away, kind="stable")[: count + 1] if others[k] != index]
        if nearest:
            found.append([_Pair(index, k, float(_in_picture(points, k, into)[2].mean())) for k in nearest])
    return found


def _sample(part: PlacedMap, index: int) -> Float:
    points = part.reference(index).points
    if not len(points):
        return np.zeros((0, 3))
    chosen = np.unique(np.linspace(0, len(points) - 1, SAMPLED_POINTS).astype(int))
    return part.submap_pose_of(index).apply(points[chosen].astype(float))


def _in_picture(points: Float, index: int, part: PlacedMap) -> tuple[Float, Float, Bool]:
    """Return pixels (N, 2) and depths (N,) of map points in a frame, and which of them are in its picture."""
    camera = part.frames[index].camera
    in_camera = part.map_from_cam(index).inverse().apply(points)
    pixels = camera.project(in_camera)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
    return pixels, in_camera[:, 2], np.asarray(inside)


def _agreeing(pair: _Pair, source: PlacedMap, into: PlacedMap, into_from_source: Sim3) -> float:
    """Return the share of a frame's points that lie as deep in the other as it has it; NaN where it knows too few."""
    from scipy.spatial import cKDTree

    reference = into.reference(pair.other)
    pixels, depths, inside = _in_picture(into_from_source.apply(_sample(source, pair.frame)), pair.other, into)
    if not len(reference.points):
        return float("nan")
    stored = into.submap_pose_of(pair.other).apply(reference.points.astype(float))
    stored_depths = into.map_from_cam(pair.other).inverse().apply(stored)[:, 2]
    away, nearest = cKDTree(reference.pixels + 0.5).query(pixels[inside])
    close = away <= CLOSE * into.frames[pair.other].camera.width
    if close.sum() < MIN_OVERLAP_POINTS:
        return float("nan")
    ratio = np.log(depths[inside][close] / stored_depths[nearest[close]])
    return float((np.abs(ratio) <= DEPTH_TOLERANCE).mean())


def _unlike(across: Sequence[_Pair], within: Sequence[_Pair], similarities: Similar) -> float | None:
    """Return the share of pairs across that look like unrelated pictures rather than like neighbours.

    Neighbours are pairs within a fragment that share as much of the ground; the border is half way between.
    """
    frames = sorted({pair.frame for pair in (*across, *within)})
    unrelated = float(np.median(similarities(frames, frames)))
    shared = np.array([pair.shared for pair in within])
    usual = np.array([float(similarities([pair.frame], [pair.other])[0, 0]) for pair in within])
    told = []
    for pair in across:
        alike = usual[np.abs(shared - pair.shared) <= SIMILAR_SHARE]
        if pair.shared >= SHARED and len(alike) >= MIN_PAIRS:
            border = 0.5 * (unrelated + float(np.median(alike)))
            told.append(float(similarities([pair.frame], [pair.other])[0, 0]) < border)
    return float(np.mean(told)) if told else None
