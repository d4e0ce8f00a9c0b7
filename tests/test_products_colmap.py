from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, which otherwise aborts the process in later deflate calls
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from onthefly3r.products.colmap import SparsePoints, write_model
from onthefly3r.records import PlacedCamera

FIRST = Camera(1600, 900, 950.4, 951.1, 800.25, 449.5, (-0.015, 0.014, 0.001, -0.002))
SECOND = Camera(800, 600, 475.0, 475.0, 400.0, 300.0)
CENTRES = np.array(
    [[576_700.123456789, 5_188_100.5, 200.25], [576_720.0, 5_188_100.0, 201.0], [576_740.0, 5_188_101.0, 199.0]]
)


def cameras(names: tuple[str, ...] = ("a/Ü.jpg", "b/Ü.jpg", "c.jpg")) -> list[PlacedCamera]:
    rng = np.random.default_rng(0)
    down = np.diag([1.0, -1.0, -1.0])
    return [
        PlacedCamera(
            3 * i, name, SECOND if i == 2 else FIRST, Rigid3(rotation_exp(rng.normal(0, 0.1, 3)) @ down, centre), 0
        )
        for i, (name, centre) in enumerate(zip(names, CENTRES, strict=True))
    ]


def observed(placed: list[PlacedCamera]) -> SparsePoints:
    rng = np.random.default_rng(1)
    points = np.array([576_720.0, 5_188_100.0, 160.0]) + rng.normal(0, 5, (20, 3))
    point, image = (grid.ravel() for grid in np.meshgrid(np.arange(20), [0, 3, 6, 99], indexing="ij"))
    pixels = np.zeros((len(point), 2))
    for camera in placed:
        seen = image == camera.index
        pixels[seen] = camera.camera.project(camera.world_from_cam.inverse().apply(points[point[seen]]))
    order = rng.permutation(len(point))
    rgb = rng.integers(0, 256, (20, 3)).astype(np.uint8)
    return SparsePoints(points, rgb, rng.uniform(0, 1, 20), point[order], image[order], pixels[order])


def read(folder: Path, form: str) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    {"text": model.read_text, "binary": model.read_binary, "either": model.read}[form](str(folder))
    return model


@pytest.mark.parametrize("form", ["text", "binary"])
def test_pycolmap_reads_cameras_poses_and_tracks(tmp_path: Path, form: str) -> None:
    placed = cameras()
    sparse = observed(placed)
    write_model(tmp_path, placed, sparse)
    model = read(tmp_path, form)
    names = [f"{name}.{suffix}" for name in ("cameras", "images", "points3D") for suffix in ("bin", "txt")]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    assert model.num_cameras() == 2
    for camera in placed:
        image = model.images[camera.index + 1]
        assert image.name == camera.name
        assert np.abs(image.projection_center() - camera.world_from_cam.translation).max() < 1e-6
        rotation = image.cam_from_world().rotation.matrix()
        assert np.allclose(rotation, camera.world_from_cam.rotation.T, atol=1e-9)
        model_camera = model.cameras[image.camera_id]
        assert model_camera.model.name == "OPENCV"
        wanted = [camera.camera.fx, camera.camera.fy, camera.camera.cx, camera.camera.cy, *camera.camera.distortion]
        assert model_camera.params.tolist() == wanted
        assert (model_camera.width, model_camera.height) == (camera.camera.width, camera.camera.height)
    assert model.num_points3D() == 20
    for number, point in model.points3D.items():
        assert point.xyz.tolist() == sparse.points[number - 1].tolist()
        assert point.color.tolist() == sparse.rgb[number - 1].tolist()
        assert {element.image_id for element in point.track.elements} == {1, 4, 7}
        for element in point.track.elements:  # the model must reproject onto its own observations
            image = model.images[element.image_id]
            seen = image.points2D[element.point2D_idx]
            assert seen.point3D_id == number
            assert image.project_point(point.xyz) == pytest.approx(seen.xy, abs=1e-4)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_poses_alone(tmp_path: Path, form: str) -> None:
    write_model(tmp_path, cameras())
    model = read(tmp_path, form)
    assert (model.num_reg_images(), model.num_points3D()) == (3, 0)


def test_colmap_reads_names_with_spaces_whole(tmp_path: Path) -> None:
    placed = cameras(("flight 1/a.jpg", "flight 1/b 2.jpg", "Flüge  1/c.jpg"))
    write_model(tmp_path, placed, observed(placed))
    model = read(tmp_path, "either")
    assert {i: image.name for i, image in model.images.items()} == {c.index + 1: c.name for c in placed}
    assert all(f" {camera.name}\n" in (tmp_path / "images.txt").read_text(encoding="utf-8") for camera in placed)


def test_an_undecodable_name_keeps_its_bytes(tmp_path: Path) -> None:
    write_model(tmp_path, cameras(("a.jpg", "b \udcff.jpg", "c.jpg")))
    assert b"b \xff.jpg\0" in (tmp_path / "images.bin").read_bytes()
    assert b" b \xff.jpg\n" in (tmp_path / "images.txt").read_bytes()
    assert read(tmp_path, "binary").num_reg_images() == 3
