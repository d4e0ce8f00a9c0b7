"""Named camera poses and how the images of two sets are matched."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ..errors import ReferenceFormatError
from ..geometry.arrays import Float, Int
from ..geometry.transforms import Rigid3, Sim3


@dataclass(frozen=True)
class PoseSet:
    """Camera poses in one frame, in capture order as far as the file tells it."""

    source: Path  # the file, for messages
    names: tuple[str, ...]
    centres: Float  # (N, 3) world, any unit
    rotations: Float  # (N, 3, 3) world_from_cam, OpenCV axes

    @classmethod
    def from_poses(cls, source: Path, names: Sequence[str], world_from_cam: Sequence[Rigid3]) -> PoseSet:
        """Build from one transform per image."""
        centres = np.array([pose.translation for pose in world_from_cam], float).reshape(-1, 3)
        rotations = np.array([pose.rotation for pose in world_from_cam], float).reshape(-1, 3, 3)
        return cls(source, tuple(names), centres, rotations)

    def take(self, rows: Sequence[int] | Int) -> PoseSet:
        """Return the poses in these rows, in this order."""
        rows = np.asarray(rows, np.int64)
        return PoseSet(self.source, tuple(self.names[k] for k in rows), self.centres[rows], self.rotations[rows])

    def moved(self, target_from_world: Sim3) -> PoseSet:
        """Return the poses in another frame."""
        return PoseSet(
            self.source, self.names, target_from_world.apply(self.centres), target_from_world.rotation @ self.rotations
        )


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sorting key that orders numbers in names by value: DJI_9 before DJI_10."""
    parts = re.split(r"(\d+)", name.lower())
    return tuple((1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts)


def match(estimate: PoseSet, reference: PoseSet) -> tuple[Int, Int]:
    """Return the rows (M,) of the images that both sets hold, in the order of the estimate.

    An image matches by its whole relative name, else, case-insensitively, by a file name (last part) that is unique in
    both sets. A set whose images are only numbered matches one of the same length by order.

    Raises:
        ReferenceFormatError: a file name could match several images, or nothing matches.
    """
    if len(estimate.names) == len(reference.names) and (_numbered(estimate) != _numbered(reference)):
        # A KITTI file numbers its images in capture order and has no names.
        rows = np.arange(len(estimate.names))
        return rows, rows
    by_name = {name: k for k, name in enumerate(reference.names)}
    by_file: dict[str, list[int]] = {}
    for k, name in enumerate(reference.names):
        by_file.setdefault(_file_name(name), []).append(k)
    used = {by_name[name] for name in estimate.names if name in by_name}
    files = Counter(_file_name(name) for name in estimate.names if name not in by_name)
    pairs: list[tuple[int, int]] = []
    for k, name in enumerate(estimate.names):
        if name in by_name:
            pairs.append((k, by_name[name]))
            continue
        file = _file_name(name)
        candidates = [r for r in by_file.get(file, []) if r not in used]
        if len(candidates) > 1 or (candidates and files[file] > 1):
            same = ", ".join(reference.names[r] for r in candidates)
            raise ReferenceFormatError(
                f"{reference.source}: {name} of {estimate.source} could be {same}; "
                "give the images of both the same relative names"
            )
        if candidates:
            pairs.append((k, candidates[0]))
    if not pairs:
        raise ReferenceFormatError(
            f"{reference.source}: none of its {len(reference.names)} images (first: {_first(reference)}) is among the "
            f"{len(estimate.names)} of {estimate.source} (first: {_first(estimate)}); compare the image names"
        )
    rows = np.array(pairs, np.int64)
    return rows[:, 0], rows[:, 1]


def _numbered(poses: PoseSet) -> bool:
    return all(name == str(k) for k, name in enumerate(poses.names))


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name.casefold()


def _first(poses: PoseSet) -> str:
    return poses.names[0] if poses.names else "none"
