from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, which otherwise aborts the process in later deflate calls
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate.readers import read_poses, scene_depth
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.frames import omega_phi_kappa_deg, world_from_cam_rotation
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from onthefly3r.products.colmap import SparsePoints, write_model
from onthefly3r.products.rows import placed_row, rejected_row
from onthefly3r.products.trajectory_table import write_trajectory
from onthefly3r.records import PlacedCamera, Shot

CAMERA = Camera(1600, 900, 950.0, 950.0, 800.0, 450.0)


def placed(names: list[str]) -> list[PlacedCamera]:
    rng = np.random.default_rng(3)
    origin = np.array([576_700.0, 5_188_100.0, 200.0])
    down = np.diag([1.0, -1.0, -1.0])
    poses = [Rigid3(rotation_exp(rng.normal(0, 0.3, 3)) @ down, origin + rng.normal(0, 50, 3)) for _ in names]
    return [PlacedCamera(k, name, CAMERA, pose, 0) for k, (name, pose) in enumerate(zip(names, poses, strict=True))]


def shot(name: str) -> Shot:
    return Shot(name, Path(name), 1600, 900, "cam", 0.6, 0.05, "guess")


def assert_poses(path: Path, wanted: list[PlacedCamera], centre_m: float, rotation: float) -> None:
    read = read_poses(path)
    assert list(read.names) == [camera.name for camera in wanted]
    for k, camera in enumerate(wanted):
        assert np.abs(read.centres[k] - camera.world_from_cam.translation).max() < centre_m
        assert np.abs(read.rotations[k] - camera.world_from_cam.rotation).max() < rotation


@given(angles=st.tuples(st.floats(-180, 180), st.floats(-89.9, 89.9), st.floats(-180, 180)))
def test_omega_phi_kappa_and_back(angles: tuple[float, float, float]) -> None:
    rotation = world_from_cam_rotation(*angles)
    assert np.allclose(world_from_cam_rotation(*omega_phi_kappa_deg(rotation)), rotation, atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("with_points", [True, False])
def test_colmap_text_written_by_us(tmp_path: Path, with_points: bool) -> None:
    cameras = placed(["flight 1/ü 1.jpg", "flight 1/ü 2.jpg", "flight 1/ü 10.jpg"])
    sparse = SparsePoints(
        np.zeros((2, 3)),
        np.zeros((2, 3), np.uint8),
        np.zeros(2),
        np.array([0, 1, 0]),
        np.array([0, 0, 2]),
        np.ones((3, 2)),
    )
    write_model(tmp_path / "colmap", cameras[::-1], sparse if with_points else None)
    assert_poses(tmp_path, cameras, 1e-6, 1e-9)


def test_colmap_text_written_by_pycolmap(tmp_path: Path) -> None:
    import pycolmap

    cameras = placed(["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    write_model(tmp_path / "ours", cameras)
    (tmp_path / "theirs").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "ours")).write_text(str(tmp_path / "theirs"))
    assert_poses(tmp_path / "theirs", cameras, 1e-6, 1e-9)


@pytest.mark.parametrize("between", ["\n", "", "1.5 2.5 -1 3.0 4.0 17\n"], ids=["empty", "left out", "filled"])
def test_colmap_lines_of_points(tmp_path: Path, between: str) -> None:
    lines = [f"{k} 1 0 0 0 {k} 0 0 1 my image {k}.jpg\n{between}" for k in (2, 1, 3)]
    (tmp_path / "images.txt").write_text("# comment\n" + "".join(lines))
    read = read_poses(tmp_path)
    assert read.names == ("my image 1.jpg", "my image 2.jpg", "my image 3.jpg")
    assert read.centres[:, 0].tolist() == [-1.0, -2.0, -3.0]


def test_our_table(tmp_path: Path) -> None:
    cameras = placed(["z.jpg", "a/b, c.jpg", "m.jpg"])
    rows = [placed_row(camera, shot(camera.name)) for camera in cameras]
    rows.insert(1, rejected_row(shot("lost.jpg"), 4, "no"))
    write_trajectory(tmp_path / "trajectory.csv", rows)
    assert_poses(tmp_path, cameras, 1e-5, 1e-7)


def test_tum(tmp_path: Path) -> None:
    file = tmp_path / "truth.tum"
    half = 0.5**0.5
    file.write_text(f"# stamp tx ty tz qx qy qz qw\n1.5 1 2 3 0 0 0 1\nmy image.jpg 4 5 6 0 0 {half} {half}\n")
    read = read_poses(file)
    assert read.names == ("1.5", "my image.jpg")
    assert read.centres.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert np.allclose(read.rotations[1] @ [1, 0, 0], [0, 1, 0])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("images.txt", "1 1 0 0 0 0 0 0 1\n", "line 1: expected IMAGE_ID"),
        ("images.txt", "# x\n1 1 0 0 0 0 zero 0 1 a.jpg\n", "line 2: 'zero' is not a number"),
        ("images.txt", "1 1 0 0 0 0 nan 0 1 a.jpg\n", "line 1: 'nan' is not finite"),
        ("images.txt", "1 0 0 0 0 0 0 0 1 a.jpg\n", "line 1: the quaternion has length 0"),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 a.jpg\n", "a.jpg appears 2 times"),
        ("images.txt", "# nothing\n", "holds no camera pose"),
        ("t.csv", "image,x,y,z\n", "line 1: no column omega, phi, kappa"),
        ("t.csv", "image,x,y,z,omega,phi,kappa\na,1,2,3,4,5,\n", "line 2: '' is not a number"),
        ("t.tum", "1 2 3\n", "line 1: expected timestamp"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_line(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ReferenceFormatError) as error:
        read_poses(tmp_path / name)
    assert message in str(error.value)
    assert str(tmp_path / name) in str(error.value)


def test_folders_without_poses(tmp_path: Path) -> None:
    with pytest.raises(ReferenceFormatError, match="no such file"):
        read_poses(tmp_path / "nowhere")
    with pytest.raises(ReferenceFormatError, match="neither trajectory"):
        read_poses(tmp_path)
    (tmp_path / "images.bin").write_bytes(b"")
    with pytest.raises(ReferenceFormatError, match="ends too early"):
        read_poses(tmp_path)


def test_scene_depth_beside_the_reference(tmp_path: Path) -> None:
    assert scene_depth(tmp_path) is None
    (tmp_path / "summary.json").write_text('{"median_scene_depth": 4.5}')
    assert scene_depth(tmp_path) == scene_depth(tmp_path / "images.txt") == 4.5
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(ReferenceFormatError, match=r"summary\.json"):
        scene_depth(tmp_path)
