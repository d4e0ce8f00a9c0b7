"""Camera poses from COLMAP text models, TUM files and our own table; `other_readers.py` has more formats."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from ..errors import ReferenceFormatError
from ..files.strict_json import loads
from ..geometry.arrays import Float
from ..geometry.frames import world_from_cam_rotation
from ..geometry.transforms import Rigid3
from .other_readers import read_arrays, read_colmap_binary, read_kitti, read_nerfstudio
from .poses import PoseSet, natural_key

POSE_COLUMNS = ("image", "x", "y", "z", "omega", "phi", "kappa")


def read_poses(path: Path) -> PoseSet:
    """Read camera poses from whatever `path` is.

    A folder may be an output folder of ours (trajectory.csv), a COLMAP model (images.txt or images.bin), or hold one
    in `colmap/`, `sparse/0/` or `sparse/`, or a transforms.json of nerfstudio. A file may be one of these, a .csv table
    like ours, .npz (names, world_from_cam), or a TUM or KITTI trajectory (any other name).

    Raises:
        ReferenceFormatError: missing, not one of these, or wrong in a line that the message names.
    """
    file = _pose_file(path)
    if file.suffix.lower() == ".csv":
        poses = read_trajectory_csv(file)
    elif file.name.lower() == "images.txt":
        poses = read_colmap_images(file)
    elif file.suffix.lower() == ".bin":
        poses = read_colmap_binary(file)
    elif file.suffix.lower() == ".json":
        poses = read_nerfstudio(file)
    elif file.suffix.lower() == ".npz":
        poses = read_arrays(file)
    else:
        poses = _read_kitti(file) or read_tum(file)
    if not poses.names:
        raise ReferenceFormatError(f"{file}: holds no camera pose")
    name, times = Counter(poses.names).most_common(1)[0]
    if times > 1:
        raise ReferenceFormatError(f"{file}: image {name} appears {times} times")
    return poses


def read_colmap_images(path: Path) -> PoseSet:
    """Read images.txt of a COLMAP text model; images come out ordered by name, because the file order is arbitrary.

    After each image its line of points is skipped, whether filled, empty or left out.
    """
    names: list[str] = []
    poses: list[Rigid3] = []
    expect_points = False
    for number, line in _lines(path):
        if line.startswith("#"):
            continue
        words = line.split()
        if expect_points and (not words or _is_points2d(words)):
            expect_points = False
            continue
        expect_points = False
        if not words:
            continue
        fields = line.split(None, 9)
        if len(fields) < 10:
            raise ReferenceFormatError(
                f"{path}, line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {line[:80]!r}"
            )
        values = _floats(path, number, fields[1:8])
        rotation = _rotation(path, number, (values[1], values[2], values[3], values[0]))
        poses.append(Rigid3(rotation, np.array(values[4:7])).inverse())
        names.append(fields[9].strip())
        expect_points = True
    order = sorted(range(len(names)), key=lambda k: natural_key(names[k]))
    return PoseSet.from_poses(path, names, poses).take(order)


def read_tum(path: Path) -> PoseSet:
    """Read a TUM trajectory, `timestamp tx ty tz qx qy qz qw` (world from camera) per line, in file order.

    The first word is the image's name: a time stamp, or the file name that many tools write in its place.
    """
    names: list[str] = []
    poses: list[Rigid3] = []
    for number, line in _lines(path):
        if line.startswith("#") or not line.strip():
            continue
        fields = line.replace(",", " ").split()
        if len(fields) < 8:
            raise ReferenceFormatError(
                f"{path}, line {number}: expected timestamp tx ty tz qx qy qz qw, found {line[:80]!r}"
            )
        values = _floats(path, number, fields[-7:])
        rotation = _rotation(path, number, (values[3], values[4], values[5], values[6]))
        names.append(" ".join(fields[:-7]))
        poses.append(Rigid3(rotation, np.array(values[:3])))
    return PoseSet.from_poses(path, names, poses)


def read_trajectory_csv(path: Path) -> PoseSet:
    """Read the placed images of a table like our trajectory.csv (image, x, y, z, omega, phi, kappa), in file order.

    Rows whose `status` is not `placed` are left out; without that column all rows count.
    """
    names: list[str] = []
    poses: list[Rigid3] = []
    with _opened(path) as text:
        reader = csv.DictReader(text)
        missing = [column for column in POSE_COLUMNS if column not in (reader.fieldnames or ())]
        if missing:
            raise ReferenceFormatError(f"{path}, line 1: no column {', '.join(missing)}; found {reader.fieldnames}")
        for row in reader:
            if (row.get("status") or "placed") != "placed":
                continue
            values = _floats(path, reader.line_num, [row[column] or "" for column in POSE_COLUMNS[1:]])
            names.append(str(row["image"]))
            poses.append(Rigid3(world_from_cam_rotation(*values[3:6]), np.array(values[:3])))
    return PoseSet.from_poses(path, names, poses)


def _read_kitti(path: Path) -> PoseSet | None:
    """Read a KITTI trajectory, None when the first line is not made of twelve numbers."""
    rows: list[list[float]] = []
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) != 12:
            if not rows:
                return None
            raise ReferenceFormatError(f"{path}, line {number}: expected twelve numbers, found {line[:80]!r}")
        if not rows and not _are_numbers(words):
            return None
        rows.append(_floats(path, number, words))
    return read_kitti(path, rows) if rows else None


def _are_numbers(words: Sequence[str]) -> bool:
    try:
        [float(word) for word in words]
    except ValueError:
        return False
    return True


def scene_depth(path: Path) -> float | None:
    """Return median_scene_depth of the summary.json beside reference poses, in their unit; None where there is none."""
    summary = (path if path.is_dir() else path.parent) / "summary.json"
    if not summary.is_file():
        return None
    try:
        content = loads(summary.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ReferenceFormatError(f"{summary}: not JSON ({error})") from None
    depth = content.get("median_scene_depth") if isinstance(content, dict) else None
    return float(depth) if isinstance(depth, int | float) and depth > 0.0 else None


def _pose_file(path: Path) -> Path:
    if path.is_file():
        return path
    if not path.exists():
        raise ReferenceFormatError(f"{path}: no such file or folder")
    models = [f"{folder}images.{kind}" for folder in ("", "colmap/", "sparse/0/", "sparse/") for kind in ("txt", "bin")]
    for name in ("trajectory.csv", *models, "transforms.json"):
        if (path / name).is_file():
            return path / name
    raise ReferenceFormatError(f"{path}: holds neither trajectory.csv nor a COLMAP model nor transforms.json")


def _is_points2d(words: Sequence[str]) -> bool:
    """Tell (X, Y, POINT3D_ID) triples from an image line, which ends in a name."""
    if len(words) % 3:
        return False
    try:
        int(words[2])
        float(words[-3]), float(words[-2]), int(words[-1])
    except ValueError:
        return False
    return True


@contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as text:
            yield text
    except OSError as error:
        raise ReferenceFormatError(f"{path}: cannot be read ({error.strerror})") from None


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    with _opened(path) as text:
        for number, line in enumerate(text, start=1):
            yield number, line.rstrip("\r\n")


def _floats(path: Path, number: int, words: Sequence[str]) -> list[float]:
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            raise ReferenceFormatError(f"{path}, line {number}: {word!r} is not a number") from None
        if not math.isfinite(value):
            raise ReferenceFormatError(f"{path}, line {number}: {word!r} is not finite")
        values.append(value)
    return values


def _rotation(path: Path, number: int, quaternion_xyzw: tuple[float, float, float, float]) -> Float:
    from scipy.spatial.transform import Rotation

    norm = math.sqrt(sum(q * q for q in quaternion_xyzw))
    if not 0.9 < norm < 1.1:
        raise ReferenceFormatError(f"{path}, line {number}: the quaternion has length {norm:.3g}, not 1")
    return np.asarray(Rotation.from_quat(quaternion_xyzw).as_matrix())
