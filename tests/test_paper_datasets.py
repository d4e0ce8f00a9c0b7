"""The paper's data sets in miniature, in the layout in which they are published."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import InputError, ReferenceFormatError
from onthefly3r.geometry.transforms import rotation_exp
from paper.datasets import SCENES, SEVEN_SCENES, read_scene
from paper.run_scene import link_photographs

PLY = b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"


def write_images_txt(folder: Path, names: list[str], blank: str = "\n") -> None:
    """A COLMAP text model: cameras at (k, 0, 0), axes along the world's."""
    folder.mkdir(parents=True)
    lines = ["# Image list with two lines of data per image:"]
    lines += [f"{k + 1} 1 0 0 0 {-k} 0 0 1 {name}{blank}" for k, name in enumerate(names)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


@pytest.mark.parametrize(
    ("scene", "folder", "model"),
    [
        ("HAV", "HAV/colmap_metrics", "sparse/0"),
        ("SMBU", "SMBU_COLMAP", "sparse"),
        ("SZIT", "SZIIT", "sparse/0"),
        ("SZTU", "SZTU", "sparse/0"),
    ],
)
def test_gauu_scene(tmp_path: Path, scene: str, folder: str, model: str) -> None:
    names = [f"DJI_20231219115048_{k:04d}_Zenmuse-L1-mission.JPG" for k in (84, 9, 103)]
    root = tmp_path / folder
    write_images_txt(root / model, names)
    touch(*(root / "images" / name for name in [*names, "DJI_20231219115048_0104_Zenmuse-L1-mission.JPG"]))
    (root / model / "points3D.ply").write_bytes(PLY * 9)
    lidar = tmp_path / folder.split("/")[0] / "lidar.ply"
    lidar.write_bytes(PLY)
    found = read_scene(scene, tmp_path)
    assert [path.name[19:23] for path in found.images] == ["0009", "0084", "0103", "0104"]
    assert found.names == tuple(path.name for path in found.images)
    assert found.reference.names == found.names[:3]
    np.testing.assert_allclose(found.reference.centres[:, 0], [1.0, 0.0, 2.0])
    assert found.cloud == lidar


@pytest.mark.parametrize("scene", ["Residence", "Campus"])
def test_urban_scene_with_flights_in_folders(tmp_path: Path, scene: str) -> None:
    root = tmp_path / scene
    names = ["0000.jpg", "0001.jpg", "0002.jpg"]
    write_images_txt(root / "sparse" / "0", names, blank="")
    touch(root / "photos" / "flight2" / names[0], root / "photos" / "flight10" / names[1])
    touch(root / "photos" / "flight10" / names[2])
    (root / "itwin.las").write_bytes(b"LASF" * 9)
    found = read_scene(scene, tmp_path)
    # The reference names files alone: the scene calls them as the reference does, in the order of the flights.
    assert found.names == ("0000.jpg", "0001.jpg", "0002.jpg")
    assert [path.parent.name for path in found.images] == ["flight2", "flight10", "flight10"]
    assert found.cloud == root / "itwin.las"


def seven_scenes(root: Path, scene: str, frames: int) -> None:
    folder = root / SEVEN_SCENES[scene] / "seq-01"
    for k in range(frames):
        touch(folder / f"frame-{k:06d}.color.png", folder / f"frame-{k:06d}.depth.png")
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation_exp(np.array([0.0, 0.01 * k, 0.0])), [0.1 * k, 0.0, 1.0]
        text = "\n".join("\t".join(f"{value: .7e}" for value in row) + "\t" for row in matrix)
        (folder / f"frame-{k:06d}.pose.txt").write_text(text + "\n", encoding="ascii")


@pytest.mark.parametrize("scene", ["Chess", "Kitchen"])
def test_seven_scenes_takes_every_fifth_frame_of_sequence_01(tmp_path: Path, scene: str) -> None:
    seven_scenes(tmp_path, scene, 12)
    found = read_scene(scene, tmp_path)
    assert found.names == ("frame-000000.color.png", "frame-000005.color.png", "frame-000010.color.png")
    np.testing.assert_allclose(found.reference.centres, [[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [1.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(found.reference.rotations[1], rotation_exp(np.array([0.0, 0.05, 0.0])), atol=1e-6)
    assert found.cloud is None


@pytest.mark.parametrize("text", ["1 0 0 0\n", "nan " * 16, "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"])
def test_a_damaged_pose_is_told_by_its_file(tmp_path: Path, text: str) -> None:
    seven_scenes(tmp_path, "Fire", 6)
    path = tmp_path / "fire" / "seq-01" / "frame-000005.pose.txt"
    path.write_text(text, encoding="ascii")
    with pytest.raises(ReferenceFormatError, match=r"frame-000005\.pose\.txt"):
        read_scene("Fire", tmp_path)


def test_what_is_missing_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="HAV"):
        read_scene("HAV", tmp_path)
    (tmp_path / "HAV").mkdir()
    with pytest.raises(InputError, match="COLMAP model"):
        read_scene("HAV", tmp_path)
    write_images_txt(tmp_path / "HAV" / "sparse" / "0", ["a.jpg"])
    with pytest.raises(InputError, match="photographs"):
        read_scene("HAV", tmp_path)
    with pytest.raises(InputError, match="frame-"):
        read_scene("Stairs", tmp_path)
    with pytest.raises(InputError, match="Nowhere"):
        read_scene("Nowhere", tmp_path)
    assert len(SCENES) == 13


def test_a_run_gets_links_under_the_names_of_the_reference(tmp_path: Path) -> None:
    seven_scenes(tmp_path / "data", "Chess", 12)
    scene = read_scene("Chess", tmp_path / "data")
    for _ in range(2):  # a second time replaces its own links
        link_photographs(scene, tmp_path / "links")
    assert sorted(path.name for path in (tmp_path / "links").iterdir()) == sorted(scene.names)
    assert all(path.resolve().parent.name == "seq-01" for path in (tmp_path / "links").iterdir())


def test_a_name_may_not_lead_out_of_the_folder(tmp_path: Path) -> None:
    root = tmp_path / "data" / "Campus"
    write_images_txt(root / "sparse" / "0", ["../../a.jpg"])
    touch(root / "photos" / "a.jpg")
    scene = read_scene("Campus", tmp_path / "data")
    with pytest.raises(InputError, match="leads out"):
        link_photographs(scene, tmp_path / "links")
