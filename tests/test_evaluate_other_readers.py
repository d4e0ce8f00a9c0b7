"""Poses in the formats of other programs: the same poses come out of each, and damaged files are named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate.poses import match
from onthefly3r.evaluate.readers import read_poses
from onthefly3r.geometry.transforms import Rigid3, rotation_exp

RNG = np.random.default_rng(0)
NAMES = ["flight/ä 2.jpg", "flight/b 10.jpg", "flight/ä 1.jpg"]
POSES = [Rigid3(rotation_exp(RNG.normal(0, 1, 3)), RNG.normal(0, 100, 3)) for _ in NAMES]


def matrices() -> np.ndarray:
    bottom = np.array([0.0, 0.0, 0.0, 1.0])
    return np.array([np.vstack([np.column_stack([p.rotation, p.translation]), bottom]) for p in POSES])


def colmap_binary(folder: Path) -> Path:
    """A model that pycolmap writes."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 800, 600)
    model.add_camera_with_trivial_rig(camera)
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True), start=1):
        inverse = pose.inverse()
        placed = pycolmap.Rigid3d(pycolmap.Rotation3d(inverse.rotation), inverse.translation)
        points = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0]))] * number)
        image = pycolmap.Image(name=name, camera_id=1, image_id=number, points2D=points)
        model.add_image_with_trivial_frame(image, placed)
    folder.mkdir()
    model.write_binary(str(folder))
    return folder


def nerfstudio(path: Path) -> Path:
    opengl = matrices() @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [{"file_path": n, "transform_matrix": m.tolist()} for n, m in zip(NAMES, opengl, strict=True)]
    path.write_text(json.dumps({"frames": frames}), encoding="utf-8")
    return path


def arrays(path: Path) -> Path:
    np.savez(path, names=np.array(NAMES), world_from_cam=matrices()[:, :3])
    return path


def poses_by_name(path: Path) -> dict[str, Rigid3]:
    found = read_poses(path)
    return {n: Rigid3(r, c) for n, r, c in zip(found.names, found.rotations, found.centres, strict=True)}


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio", "arrays"])
def test_the_same_poses_come_out(tmp_path: Path, kind: str) -> None:
    path = {
        "colmap": lambda: colmap_binary(tmp_path / "model"),
        "nerfstudio": lambda: nerfstudio(tmp_path / "transforms.json"),
        "arrays": lambda: arrays(tmp_path / "poses.npz"),
    }[kind]()
    found = poses_by_name(path)
    assert set(found) == set(NAMES)
    for name, pose in zip(NAMES, POSES, strict=True):
        np.testing.assert_allclose(found[name].rotation, pose.rotation, atol=1e-12)
        np.testing.assert_allclose(found[name].translation, pose.translation, atol=1e-9)


def test_kitti_matches_by_order(tmp_path: Path) -> None:
    path = tmp_path / "00.txt"
    path.write_text("\n".join(" ".join(map(repr, m[:3].ravel().tolist())) for m in matrices()) + "\n")
    kitti, named = read_poses(path), read_poses(arrays(tmp_path / "poses.npz"))
    np.testing.assert_allclose(kitti.centres, named.centres)
    assert [rows.tolist() for rows in match(named, kitti)] == [[0, 1, 2], [0, 1, 2]]


def test_damaged_binary_models_are_named(tmp_path: Path) -> None:
    good = (colmap_binary(tmp_path / "model") / "images.bin").read_bytes()
    path = tmp_path / "images.bin"
    rng = np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(good[: rng.integers(0, len(good))] if rng.random() < 0.5 else good)
        for at in rng.integers(0, len(data), 2) if data else ():
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            read_poses(path)
        except ReferenceFormatError as error:
            assert "images.bin" in str(error)


@pytest.mark.parametrize(
    "text",
    ["", "{}", "[]", '{"frames": [{"file_path": "a"}]}', "[" * 100_000, '{"frames": [{"file_path": "a", '
     '"transform_matrix": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}'],
)  # fmt: skip
def test_other_json_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(ReferenceFormatError, match=r"transforms\.json"):
        read_poses(tmp_path)
