"""The cameras and a few points as a COLMAP model, as text for people and other programs and as binary for COLMAP."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..files.atomic import replacing
from ..geometry.arrays import Float, Int, UInt8
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from ..records import PlacedCamera


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
    """Write a COLMAP model in the export frame, with OPENCV cameras at the size of the photographs.

    The same model as cameras, images and points3D, each .txt and .bin: COLMAP reads a name in text only up to its first
    space, and takes the binary files where both are. Undecodable names are written as the bytes of the file system.

    IMAGE_ID is the shot index + 1; images with equal intrinsics share a camera. Numbers keep all their digits, because
    projected coordinates are large. Observations in images that are not among `cameras` are left out, and so are points
    that no camera sees.

    Format: https://colmap.github.io/format.html
    """
    camera_ids: dict[Camera, int] = {}
    for placed in cameras:
        camera_ids.setdefault(placed.camera, len(camera_ids) + 1)
    tracks = _tracks(cameras, sparse)
    _write_lines(folder / "cameras.txt", _camera_lines(camera_ids))
    _write_lines(folder / "images.txt", _image_lines(cameras, camera_ids, tracks))
    _write_lines(folder / "points3D.txt", _point_lines(sparse, tracks))
    _write_bytes(folder / "cameras.bin", _camera_bytes(camera_ids))
    _write_bytes(folder / "images.bin", _image_bytes(cameras, camera_ids, tracks))
    _write_bytes(folder / "points3D.bin", _point_bytes(sparse, tracks))


@dataclass(frozen=True)
class _Tracks:
    """Observations of the placed images, ordered by point."""

    point: Int  # (M,)
    image: Int  # (M,) shot index
    pixels: Float  # (M, 2)
    slot: Int  # (M,) POINT2D_IDX within the image
    of_image: Mapping[int, Int]  # rows of each image that sees points, by slot

    def by_point(self) -> Iterator[tuple[int, slice]]:
        """Yield each point with the slice of its observations."""
        points, first = np.unique(self.point, return_index=True)
        for point, start, stop in zip(points, first, [*first[1:], len(self.point)], strict=True):
            yield int(point), slice(int(start), int(stop))


def _tracks(cameras: Sequence[PlacedCamera], sparse: SparsePoints | None) -> _Tracks | None:
    if sparse is None or not len(sparse.point):
        return None
    order = np.lexsort((sparse.image, sparse.point))
    order = order[np.isin(sparse.image[order], [placed.index for placed in cameras])]
    point, image, pixels = sparse.point[order], sparse.image[order], sparse.pixels[order]
    by_image = np.argsort(image, kind="stable")
    indices, first = np.unique(image[by_image], return_index=True)
    of_image = dict(zip(indices.tolist(), np.split(by_image, first[1:]), strict=True)) if len(indices) else {}
    slot = np.zeros(len(order), np.int64)
    for seen in of_image.values():
        slot[seen] = np.arange(len(seen))
    return _Tracks(point, image, pixels, slot, of_image)


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
        yield f"{placed.index + 1} {_numbers(_pose(placed))} {camera_ids[placed.camera]} {placed.name}"
        if tracks is None:
            yield ""
            continue
        seen = tracks.of_image.get(placed.index, ())
        yield " ".join(f"{_numbers(tracks.pixels[k])} {tracks.point[k] + 1}" for k in seen)


def _point_lines(sparse: SparsePoints | None, tracks: _Tracks | None) -> Iterator[str]:
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    if sparse is None or tracks is None:
        return
    for point, seen in tracks.by_point():
        track = " ".join(f"{i + 1} {slot}" for i, slot in zip(tracks.image[seen], tracks.slot[seen], strict=True))
        r, g, b = sparse.rgb[point]
        yield f"{point + 1} {_numbers(sparse.points[point])} {r} {g} {b} {float(sparse.error_px[point])!r} {track}"


OPENCV_MODEL_ID = 4  # the binary files number the camera models


def _camera_bytes(camera_ids: dict[Camera, int]) -> Iterator[bytes]:
    yield struct.pack("<Q", len(camera_ids))
    for camera, number in camera_ids.items():
        parameters = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
        yield struct.pack("<IiQQ8d", number, OPENCV_MODEL_ID, camera.width, camera.height, *parameters)


def _image_bytes(
    cameras: Sequence[PlacedCamera], camera_ids: dict[Camera, int], tracks: _Tracks | None
) -> Iterator[bytes]:
    yield struct.pack("<Q", len(cameras))
    for placed in cameras:
        yield struct.pack("<I7dI", placed.index + 1, *_pose(placed), camera_ids[placed.camera])
        yield placed.name.encode("utf-8", errors="surrogateescape") + b"\0"
        seen = () if tracks is None else tracks.of_image.get(placed.index, ())
        yield struct.pack("<Q", len(seen))
        if tracks is not None:
            yield from (struct.pack("<ddQ", *tracks.pixels[k], tracks.point[k] + 1) for k in seen)


def _point_bytes(sparse: SparsePoints | None, tracks: _Tracks | None) -> Iterator[bytes]:
    if sparse is None or tracks is None:
        yield struct.pack("<Q", 0)
        return
    yield struct.pack("<Q", len(np.unique(tracks.point)))
    xyz, error_px = sparse.points.astype("<f8"), sparse.error_px.astype("<f8")
    elements = np.stack([tracks.image + 1, tracks.slot], axis=1).astype("<u4")
    for point, seen in tracks.by_point():
        yield struct.pack("<Q", point + 1) + xyz[point].tobytes() + sparse.rgb[point].tobytes()
        yield error_px[point].tobytes() + struct.pack("<Q", seen.stop - seen.start) + elements[seen].tobytes()


def _pose(placed: PlacedCamera) -> tuple[float, ...]:
    """Return QW, QX, QY, QZ, TX, TY, TZ of the camera from the world."""
    cam_from_world = placed.world_from_cam.inverse()
    return (*_quaternion_wxyz(cam_from_world), *(float(value) for value in cam_from_world.translation))


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


def _write_bytes(path: Path, pieces: Iterator[bytes]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as stream:
        stream.writelines(pieces)
