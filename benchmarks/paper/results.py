"""Camera poses that a program left behind: TUM, COLMAP text or binary, our table, or npz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate.poses import PoseSet, natural_key
from onthefly3r.evaluate.readers import read_poses
from onthefly3r.geometry.transforms import Rigid3

NAME_KEYS = ("names", "image_paths", "image_names", "frame_ids")
POSE_KEYS = ("cam2world", "camera_poses", "poses")
MAX_NPZ_BYTES = 2 * 1024**3
COLMAP_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap")


def read_result(path: Path, images: Sequence[str] = ()) -> PoseSet:
    """Read the camera poses of a program.

    Args:
        path: a .npz file, a folder with a COLMAP model in text or binary form, or what `onthefly3r evaluate` takes (TUM
            trajectory, images.txt, a table like trajectory.csv, one of our output folders).
        images: all images that the program was given, in their order; names them where the file holds no names (npz
            without names, TUM whose first column counts 0, 1, 2 ...).

    Raises:
        ReferenceFormatError: missing, or not one of these; a pose without an image.
    """
    if path.suffix.lower() == ".npz":
        return _read_npz(path, images)
    folder = next((path / part for part in COLMAP_FOLDERS if (path / part / "images.bin").is_file()), None)
    poses = read_poses(path) if folder is None else _read_colmap_binary(folder)
    return _named(poses, images)


def write_result(path: Path, names: Sequence[str], world_from_cam: Mapping[int, Rigid3]) -> None:
    """Write the poses of some of the images as npz: `names` (N,) and `cam2world` (N, 4, 4), in the order of names."""
    placed = sorted(world_from_cam)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part.npz")
    np.savez(
        temporary,
        names=np.array([names[i] for i in placed], str),
        cam2world=np.array([world_from_cam[i].matrix() for i in placed]).reshape(-1, 4, 4),
    )
    temporary.replace(path)


def _read_npz(path: Path, images: Sequence[str]) -> PoseSet:
    """Read poses (N, 4, 4) or (N, 3, 4), world from camera; `valid` (N,) may leave some out."""
    if not path.is_file():
        raise ReferenceFormatError(f"{path}: no such file")
    if path.stat().st_size > MAX_NPZ_BYTES:
        raise ReferenceFormatError(f"{path}: larger than {MAX_NPZ_BYTES} bytes; write the poses alone")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as held:
            key = next((k for k in POSE_KEYS if k in held.files), None)
            if key is None:
                raise ReferenceFormatError(f"{path}: holds none of {', '.join(POSE_KEYS)}, but {', '.join(held.files)}")
            matrices = np.asarray(held[key], float)
            name_key = next((k for k in NAME_KEYS if k in held.files), None)
            names = [str(n) for n in held[name_key]] if name_key else list(images)
            valid = np.asarray(held["valid"], bool) if "valid" in held.files else np.ones(len(matrices), bool)
    except (OSError, ValueError, BadZipFile) as error:
        if isinstance(error, ReferenceFormatError):
            raise
        raise ReferenceFormatError(
            f"{path}: cannot be read ({error}); names must be text, not Python objects"
        ) from None
    if matrices.ndim != 3 or matrices.shape[1:] not in ((4, 4), (3, 4)):
        raise ReferenceFormatError(f"{path}: {key} has shape {matrices.shape}, not (N, 4, 4) or (N, 3, 4)")
    if len(names) != len(matrices) or valid.shape != (len(matrices),):
        raise ReferenceFormatError(f"{path}: {len(matrices)} poses, {len(names)} names, {len(valid)} flags")
    kept = np.flatnonzero(valid & np.isfinite(matrices).all(axis=(1, 2)))
    if not len(kept):
        raise ReferenceFormatError(f"{path}: holds no camera pose")
    rotations = matrices[kept, :3, :3]
    if np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max() > 1e-2:
        raise ReferenceFormatError(f"{path}: {key} holds matrices whose 3 x 3 part is no rotation")
    return PoseSet(path, tuple(names[k] for k in kept), matrices[kept, :3, 3], rotations)


def _read_colmap_binary(folder: Path) -> PoseSet:
    """Read images.bin by pycolmap, images ordered by name."""
    from onthefly3r.features.pycolmap_module import load_pycolmap

    try:
        model = load_pycolmap().Reconstruction(str(folder))
    except (RuntimeError, ValueError, OSError) as error:
        raise ReferenceFormatError(f"{folder}: not a COLMAP model ({error})") from None
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda image: natural_key(image.name))
    if not images:
        raise ReferenceFormatError(f"{folder}: holds no camera pose")
    poses = []
    for image in images:
        cam_from_world = np.asarray(image.cam_from_world().matrix())
        poses.append(Rigid3(cam_from_world[:, :3], cam_from_world[:, 3]).inverse())
    return PoseSet.from_poses(folder, [image.name for image in images], poses)


def _named(poses: PoseSet, images: Sequence[str]) -> PoseSet:
    """Replace running numbers by the names of the images; time stamps and names stay."""
    counted = all(name.isdecimal() and int(name) < len(images) for name in poses.names)
    if not images or not counted or set(poses.names) & set(images):
        return poses
    return PoseSet(poses.source, tuple(images[int(n)] for n in poses.names), poses.centres, poses.rotations)
