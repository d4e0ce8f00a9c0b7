"""The paper's data sets in the layout in which they are published: photographs, reference poses, reference cloud.

| set | scenes | layout below the root |
|---|---|---|
| GauU-Scene V2 | HAV, SMBU, SZIT, SZTU | `SCENE/colmap_metrics/images`, COLMAP model in `sparse/0`, LiDAR in `SCENE` |
| UrbanScene3D | Residence, Campus | `SCENE/photos` (flights in sub-folders), model in `sparse/0`, cloud in `SCENE` |
| 7-Scenes | chess ... stairs | `SCENE/seq-01/frame-000000.color.png` and `.pose.txt` (camera to world) |

Folder names that differ in the releases (`SZIIT`, `HAV_COLMAP`, `images` beside `sparse`) are found too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from onthefly3r.errors import InputError, ReferenceFormatError
from onthefly3r.evaluate.poses import PoseSet, match, natural_key
from onthefly3r.geometry.transforms import Rigid3

from .results import read_result

GAUU_SCENE = {"HAV": ("HAV",), "SMBU": ("SMBU",), "SZIT": ("SZIT", "SZIIT"), "SZTU": ("SZTU",)}
URBAN_SCENE = {"Residence": ("Residence",), "Campus": ("Campus",)}
SEVEN_SCENES = {
    "Chess": "chess",
    "Fire": "fire",
    "Heads": "heads",
    "Office": "office",
    "Pumpkin": "pumpkin",
    "Kitchen": "redkitchen",
    "Stairs": "stairs",
}
OUTDOOR = (*GAUU_SCENE, *URBAN_SCENE)
SCENES = (*OUTDOOR, *SEVEN_SCENES)
SEQUENCE = "seq-01"
STRIDE = 5  # every fifth frame of a sequence of 7-Scenes
PHOTOGRAPHS = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}
CLOUDS = {".ply", ".las", ".laz"}
MODEL_FILES = ("images.txt", "images.bin")
POSE_FILE_BYTES = 4096


@dataclass(frozen=True)
class Scene:
    """One scene of a data set; lengths in metres."""

    name: str  # as in the paper's tables
    images: tuple[Path, ...]  # in capture order
    names: tuple[str, ...]  # of the images, as the reference names them
    reference: PoseSet
    cloud: Path | None


def read_scene(name: str, root: Path) -> Scene:
    """Find a scene of the paper below the root of its data set.

    Raises:
        InputError: unknown scene, or its photographs, reference poses or frames are not where they should be.
    """
    if name in GAUU_SCENE:
        return _read_colmap_scene(name, _scene_folder(root, GAUU_SCENE[name]), ("images", "photos"))
    if name in URBAN_SCENE:
        return _read_colmap_scene(name, _scene_folder(root, URBAN_SCENE[name]), ("photos", "images"))
    if name in SEVEN_SCENES:
        return _read_seven_scenes(name, root / SEVEN_SCENES[name] / SEQUENCE)
    raise InputError(f"scene {name!r} is not one of {', '.join(SCENES)}")


def _scene_folder(root: Path, spellings: Sequence[str]) -> Path:
    found = sorted(
        folder
        for folder in (root.iterdir() if root.is_dir() else ())
        if folder.is_dir() and any(folder.name.casefold().split("_")[0] == s.casefold() for s in spellings)
    )
    if not found:
        raise InputError(f"{root}: holds no folder {' or '.join(spellings)}; name the data set's root")
    return found[0]


def _read_colmap_scene(name: str, folder: Path, photo_folders: Sequence[str]) -> Scene:
    model = next((path.parent for path in _below(folder) if path.name in MODEL_FILES), None)
    if model is None:
        raise InputError(f"{folder}: holds no COLMAP model (images.txt or images.bin, usually in sparse/0)")
    photos = next((p for part in photo_folders for p in _folders(folder, part) if _photographs(p)), None)
    if photos is None:
        raise InputError(f"{folder}: holds no photographs in a folder {' or '.join(photo_folders)}")
    reference = read_result(model)
    paths = _photographs(photos)
    names = [path.relative_to(photos).as_posix() for path in paths]
    given = PoseSet.from_poses(photos, names, [Rigid3()] * len(names))
    rows, reference_rows = match(given, reference)  # photographs without a reference pose are given all the same
    renamed = list(names)
    for row, reference_row in zip(rows, reference_rows, strict=True):
        renamed[row] = reference.names[reference_row]
    clouds = [p for p in _below(folder) if p.suffix.lower() in CLOUDS and p.parent != model]
    largest = max(clouds, key=lambda path: path.stat().st_size, default=None)
    return Scene(name, tuple(paths), tuple(renamed), reference.take(np.sort(reference_rows)), largest)


def _read_seven_scenes(name: str, folder: Path) -> Scene:
    frames = sorted(folder.glob("frame-*.color.png"))[::STRIDE]
    if not frames:
        raise InputError(f"{folder}: holds no frame-*.color.png; unpack {SEQUENCE}.zip of the scene there")
    poses = [_read_pose(path.with_name(path.name.replace(".color.png", ".pose.txt"))) for path in frames]
    names = tuple(path.name for path in frames)
    return Scene(name, tuple(frames), names, PoseSet.from_poses(folder, names, poses), cloud=None)


def _read_pose(path: Path) -> Rigid3:
    """Read a 4 x 4 camera-to-world matrix in metres."""
    if not path.is_file() or path.stat().st_size > POSE_FILE_BYTES:
        raise ReferenceFormatError(f"{path}: missing, or no pose")
    try:
        matrix = np.array(path.read_text(encoding="ascii").split(), float).reshape(4, 4)
    except ValueError as error:
        raise ReferenceFormatError(f"{path}: not a 4 x 4 matrix ({error})") from None
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2:
        raise ReferenceFormatError(f"{path}: its rotation is not orthonormal")
    return Rigid3(rotation, matrix[:3, 3])


def _photographs(folder: Path) -> list[Path]:
    found = [path for path in folder.rglob("*") if path.suffix.lower() in PHOTOGRAPHS and path.is_file()]
    return sorted(found, key=lambda path: natural_key(path.relative_to(folder).as_posix()))


def _folders(folder: Path, name: str) -> list[Path]:
    return sorted((path for path in folder.rglob(name) if path.is_dir()), key=lambda path: len(path.parts))


def _below(folder: Path) -> list[Path]:
    """Files of a scene, those nearest to its folder first; photographs and depth maps are not looked at."""
    found = [path for path in folder.rglob("*") if path.suffix.lower() in CLOUDS or path.name in MODEL_FILES]
    return sorted(found, key=lambda path: (len(path.parts), str(path)))
