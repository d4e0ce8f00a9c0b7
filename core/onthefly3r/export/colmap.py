"""The cameras and a few points as a COLMAP text model (cameras.txt, images.txt, points3D.txt)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..geometry.arrays import Float, Int, UInt8
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from ..records import PlacedCamera
from .atomic import replacing


@dataclass(frozen=True)
class SparsePoints:
    """Points and where they were seen; observations in any order."""

    points: Float  # (N, 3) float64, export frame, m
    rgb: UInt8  # (N, 3)
    error_px: Float  # (N,) mean reprojection error
    point: Int  # (M,) which point an observation sees
    image: Int  # (M,) shot index of the image that sees it
    pixels: Float  # (M, 2) where, in the upright photograph, origin at its top-left corner


def write_model(folder: Path, cameras: Sequence[PlacedCamera], sparse: SparsePoints | None = None) -> None:
    """Write a COLMAP text model in the export frame, with OPENCV cameras at the size of the photographs.

    IMAGE_ID is the shot index + 1; images with equal intrinsics share a camera. Numbers keep all their digits, because
    projected coordinates are large. Observations in images that are not among `cameras` are left out, and so are points
    that no camera sees. Names are written whole; COLMAP itself reads a name only up to its first space.

    Format: https://colmap.github.io/format.html#text-format
    """
    camera_ids: dict[Camera, int] = {}
    for placed in cameras:
        camera_ids.setdefault(placed.camera, len(camera_ids) + 1)
    tracks = _tracks(cameras, sparse)
    _write_lines(folder / "cameras.txt", _camera_lines(camera_ids))
    _write_lines(folder / "images.txt", _image_lines(cameras, camera_ids, tracks))
    _write_lines(folder / "points3D.txt", _point_lines(sparse, tracks))


@dataclass(frozen=True)
class _Tracks:
    """Observations of the placed images, ordered by point."""

    point: Int  # (M,)
    image: Int  # (M,) shot index
    pixels: Float  # (M, 2)
    slot: Int  # (M,) POINT2D_IDX within the image


def _tracks(cameras: Sequence[PlacedCamera], sparse: SparsePoints | None) -> _Tracks | None:
    if sparse is None or not len(sparse.point):
        return None
    order = np.lexsort((sparse.image, sparse.point))
    order = order[np.isin(sparse.image[order], [placed.index for placed in cameras])]
    point, image, pixels = sparse.point[order], sparse.image[order], sparse.pixels[order]
    slot = np.zeros(len(order), np.int64)
    for index in np.unique(image):
        seen = image == index
        slot[seen] = np.arange(np.count_nonzero(seen))
    return _Tracks(point, image, pixels, slot)


def _camera_lines(camera_ids: dict[Camera, int]) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (fx, fy, cx, cy, k1, k2, p1, p2)"
    for camera, number in camera_ids.items():
        parameters = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        yield f"{number} OPENCV {camera.width} {camera.height} {_numbers(parameters)}"


def _image_lines(
    cameras: Sequence[PlacedCamera], camera_ids: dict[Camera, int], tracks: _Tracks | None
) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (camera from world)"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)"
    for placed in cameras:
        cam_from_world = placed.world_from_cam.inverse()
        pose = (*_quaternion_wxyz(cam_from_world), *cam_from_world.translation)
        yield f"{placed.index + 1} {_numbers(pose)} {camera_ids[placed.camera]} {placed.name}"
        if tracks is None:
            yield ""
            continue
        seen = np.flatnonzero(tracks.image == placed.index)
        yield " ".join(f"{_numbers(tracks.pixels[k])} {tracks.point[k] + 1}" for k in seen)


def _point_lines(sparse: SparsePoints | None, tracks: _Tracks | None) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    if sparse is None or tracks is None:
        return
    points, first = np.unique(tracks.point, return_index=True)
    for point, start, stop in zip(points, first, [*first[1:], len(tracks.point)], strict=True):
        track = " ".join(f"{tracks.image[k] + 1} {tracks.slot[k]}" for k in range(start, stop))
        r, g, b = sparse.rgb[point]
        yield f"{point + 1} {_numbers(sparse.points[point])} {r} {g} {b} {float(sparse.error_px[point])!r} {track}"


def _quaternion_wxyz(cam_from_world: Rigid3) -> tuple[float, float, float, float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = (float(q) for q in Rotation.from_matrix(cam_from_world.rotation).as_quat())
    return (w, x, y, z) if w >= 0.0 else (-w, -x, -y, -z)


def _numbers(values: Sequence[float] | Float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _write_lines(path: Path, lines: Iterator[str]) -> None:
    with (
        replacing(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="surrogateescape", newline="\n") as stream,
    ):
        stream.writelines(line + "\n" for line in lines)
