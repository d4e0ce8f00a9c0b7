"""Camera poses from the files of other programs: COLMAP binary, nerfstudio, KITTI and arrays of numpy."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, ReferenceFormatError
from ..files.array_file import ArrayFile
from ..files.strict_json import loads
from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3
from .poses import PoseSet, natural_key

MAX_JSON_BYTES = 256 * 1024 * 1024
MAX_NAME_BYTES = 4096
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])  # OpenGL cameras look along -z with y up, OpenCV's along z with y down
IMAGE_HEADER = struct.Struct("<I7dI")  # image, quaternion w x y z, translation, camera
POINT2D_BYTES = 24


def read_colmap_binary(path: Path) -> PoseSet:
    """Read images.bin of a COLMAP model (cam_from_world per image), ordered by name; raises `ReferenceFormatError`."""
    names: list[str] = []
    poses: list[Rigid3] = []
    size = path.stat().st_size
    with path.open("rb") as stream:
        (count,) = _unpacked(path, struct.Struct("<Q"), stream.read(8))
        if count * (IMAGE_HEADER.size + 9) > size:
            raise ReferenceFormatError(f"{path}: states {count} images, which do not fit into {size} bytes")
        for number in range(1, count + 1):
            values = _unpacked(path, IMAGE_HEADER, stream.read(IMAGE_HEADER.size))
            head = stream.read(MAX_NAME_BYTES)
            name, end, _ = head.partition(b"\0")
            if not end:
                raise ReferenceFormatError(f"{path}: image {number} has no readable name")
            stream.seek(len(name) + 1 - len(head), 1)
            (points,) = _unpacked(path, struct.Struct("<Q"), stream.read(8))
            if points * POINT2D_BYTES > size - stream.tell():
                raise ReferenceFormatError(f"{path}: image {number} states {points} points, more than the file holds")
            stream.seek(points * POINT2D_BYTES, 1)
            w, x, y, z = values[1:5]
            names.append(name.decode("utf-8", "surrogateescape"))
            poses.append(_cam_from_world(path, number, (x, y, z, w), np.array(values[5:8])).inverse())
    order = sorted(range(len(names)), key=lambda k: natural_key(names[k]))
    return PoseSet.from_poses(path, names, poses).take(order)


def read_nerfstudio(path: Path) -> PoseSet:
    """Read transforms.json of nerfstudio or instant-ngp: world_from_cam as 4 x 4 matrices, OpenGL camera axes."""
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"larger than {MAX_JSON_BYTES // 2**20} MiB")
        frames = loads(path.read_text(encoding="utf-8"))["frames"]
        named = [(str(frame["file_path"]), np.array(frame["transform_matrix"], float)) for frame in frames]
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ReferenceFormatError(
            f"{path}: is no transforms.json with frames, file_path and transform_matrix ({error!r})"
        ) from None
    poses = []
    for name, matrix in named:
        pose = _rigid(path, name, matrix)
        poses.append(Rigid3(pose.rotation @ CV_FROM_GL, pose.translation))
    return PoseSet.from_poses(path, [name for name, _ in named], poses)


def read_arrays(path: Path) -> PoseSet:
    """Read .npz with `names` (N,) and `world_from_cam` (N, 4, 4) or (N, 3, 4), OpenCV camera axes."""
    try:
        with ArrayFile(path) as stored:
            names = [str(name) for name in stored["names"].ravel()]
            matrices = np.asarray(stored["world_from_cam"], float)
    except (InputError, ValueError, TypeError) as error:
        raise ReferenceFormatError(f"{path}: needs the arrays names and world_from_cam ({error})") from None
    if matrices.ndim != 3 or len(matrices) != len(names):
        raise ReferenceFormatError(f"{path}: {len(names)} names, but world_from_cam has the shape {matrices.shape}")
    poses = [_rigid(path, name, matrix) for name, matrix in zip(names, matrices, strict=True)]
    return PoseSet.from_poses(path, names, poses)


def read_kitti(path: Path, rows: list[list[float]]) -> PoseSet:
    """Return the poses of a KITTI file, 12 numbers (3 x 4, world_from_cam) per line; images are numbered from 0."""
    poses = [_rigid(path, str(k), np.array(row).reshape(3, 4)) for k, row in enumerate(rows)]
    return PoseSet.from_poses(path, [str(k) for k in range(len(rows))], poses)


def _unpacked(path: Path, form: struct.Struct, data: bytes) -> tuple[Any, ...]:
    if len(data) < form.size:
        raise ReferenceFormatError(f"{path}: ends too early; it is no complete COLMAP model")
    return form.unpack(data)


def _cam_from_world(path: Path, number: int, quaternion_xyzw: tuple[float, ...], translation: Float) -> Rigid3:
    from scipy.spatial.transform import Rotation

    norm = math.sqrt(sum(q * q for q in quaternion_xyzw))
    if not (0.9 < norm < 1.1 and np.isfinite(translation).all()):
        raise ReferenceFormatError(f"{path}: image {number} has no valid pose")
    return Rigid3(np.asarray(Rotation.from_quat(quaternion_xyzw).as_matrix()), translation)


def _rigid(path: Path, name: str, matrix: Float) -> Rigid3:
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise ReferenceFormatError(f"{path}: the pose of {name} is no 4 x 4 matrix of finite numbers")
    rotation = matrix[:3, :3]
    # Entries beyond 1 first: their squares may overflow.
    if (
        np.abs(rotation).max() > 1.01
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3
        or np.linalg.det(rotation) < 0.0
    ):
        raise ReferenceFormatError(f"{path}: the pose of {name} is no rotation and translation")
    return Rigid3(rotation, matrix[:3, 3])
