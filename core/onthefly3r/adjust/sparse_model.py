"""A sparse model: poses, intrinsics, points, and which features of which images see them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..geometry.arrays import Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3


@dataclass(frozen=True)
class Track:
    """The triangulated features of one image."""

    features: Int  # (M,) index into the image's features, ascending
    points: Int  # (M,) index into SparseModel.points


@dataclass(frozen=True)
class SparseModel:
    """Poses, intrinsics and points of the images that could be placed, in an arbitrary frame."""

    local_from_cam: Mapping[int, Rigid3]
    cameras: Mapping[str, Camera]  # by camera key, working size
    points: Float  # (N, 3)
    reprojection_px: Float  # (N,) mean reprojection error
    track_length: Int  # (N,)
    tracks: Mapping[int, Track]
    mean_reprojection_px: float
