"""COPC files, read back by laspy's own reader of octrees."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.copc import Bounds, CopcReader

from onthefly3r.errors import ReconstructionError
from onthefly3r.geometry.geodesy import wkt1
from onthefly3r.products import copc
from onthefly3r.products.copc import CopcWriter, Octree
from onthefly3r.products.spool import Extent
from onthefly3r.records import CloudTile

ORIGIN = np.array([400_000.0, 5_500_000.0, 200.0])
WKT = wkt1("EPSG:32633", "egm96")


def tile_of(points: np.ndarray, first: int = 0) -> CloudTile:
    count = len(points)
    number = np.arange(first, first + count)
    return CloudTile(
        points=points,
        rgb=np.stack([number % 251, number % 241, number % 239], axis=1).astype(np.uint8),
        confidence=np.full(count, 0.5, np.float32),
        source=(number % 7).astype(np.int32),
        batch=np.zeros(count, np.int32),
        views=np.full(count, 3, np.int32),
        classification=np.where(points[:, 2] < 200.5, 2, 1).astype(np.uint8),
    )


def grid_points(side: int, spacing_m: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(side) * spacing_m, np.arange(side) * spacing_m)
    return np.stack([x, y, 0.5 + 0.5 * np.sin(x)], axis=-1).reshape(-1, 3) + ORIGIN


def write(path: Path, tiles: list[CloudTile], spacing_m: float = 0.1) -> copc.CloudSummary:
    points = np.concatenate([tile.points for tile in tiles]) if tiles else np.zeros((1, 3))
    extent = Extent(points.min(axis=0), points.max(axis=0))
    with CopcWriter(path, path.parent / "work", extent, spacing_m, WKT, 0.001, "ü", n_images=7) as writer:
        for tile in tiles:
            writer.add(tile)
    assert writer.summary is not None
    return writer.summary


@pytest.fixture
def small_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copc, "RUN_POINTS", 20_000)


def test_all_points_come_back_and_the_file_is_a_plain_laz_too(tmp_path: Path, small_runs: None) -> None:
    points = grid_points(300)
    parts = np.array_split(np.arange(len(points)), 5)
    path = tmp_path / "wölke.copc.laz"
    summary = write(path, [tile_of(points[part], int(part[0])) for part in parts])
    assert summary.points == len(points)
    plain = laspy.read(path)
    assert plain.header.point_format.id == 7
    assert plain.header.point_count == len(points)
    order_read = np.lexsort(np.rint(plain.xyz * 1000).astype(int).T)
    order_true = np.lexsort(np.rint(points * 1000).astype(int).T)
    assert np.abs(plain.xyz[order_read] - points[order_true]).max() < 0.0006
    number = np.arange(len(points))[order_true]
    assert np.array_equal(plain.red[order_read] // 257, number % 251)
    assert np.array_equal(plain.point_source_id[order_read], number % 7 + 1)
    assert set(np.unique(plain.classification)) == {1, 2}
    assert np.array_equal(plain.header.mins, plain.xyz.min(axis=0))
    assert np.array_equal(plain.header.maxs, plain.xyz.max(axis=0))
    assert plain.header.parse_crs().to_epsg() is None  # compound: UTM 33N + EGM96
    assert "UTM zone 33N" in plain.header.parse_crs().name
    assert not (tmp_path / "work" / "copc").exists()


def test_coarse_levels_are_an_even_sample_and_windows_give_their_points(tmp_path: Path, small_runs: None) -> None:
    points = grid_points(500)
    path = tmp_path / "cloud.copc.laz"
    write(path, [tile_of(part) for part in np.array_split(points, 4)])
    with CopcReader.open(path) as reader:
        whole = reader.query()
        assert len(whole) == len(points)
        coarse = reader.query(level=0)
        assert 1000 < len(coarse) < len(points) / 3
        # One of 10 m x 10 m: about as many of the coarse points as anywhere else.
        counts, *_ = np.histogram2d(coarse.x, coarse.y, bins=5)
        assert counts.min() > 0.5 * counts.mean()
        low, high = ORIGIN + np.array([10.0, 10.0, -100.0]), ORIGIN + np.array([20.0, 15.0, 100.0])
        window = reader.query(bounds=Bounds(low, high))
        expected = ((points >= low) & (points <= high)).all(axis=1).sum()
        assert abs(len(window) - expected) <= 160  # points on the rim, by the millimetre of the file


def test_points_tell_the_part_of_a_map_in_parts(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.0, 50.0, (2_000, 3))
    extent, part_of = Extent(points.min(axis=0), points.max(axis=0)), np.array([1, 1, 2, 2, 1, 3, 3])
    path = tmp_path / "cloud.copc.laz"
    with CopcWriter(path, tmp_path / "work", extent, 0.1, WKT, 0.001, n_images=7, part_of=part_of) as writer:
        writer.add(tile_of(points))
    read = laspy.read(path)
    assert np.array_equal(read["part"], part_of[np.asarray(read.point_source_id).astype(int) - 1])


def test_every_point_lies_in_its_node(tmp_path: Path) -> None:
    points = grid_points(300)
    tree = Octree.of(Extent(points.min(axis=0), points.max(axis=0)), 0.05)
    assert tree.depth >= 2
    node = tree.nodes(points, [])
    side = tree.side_m / 2.0 ** node[:, :1]
    low = tree.corner + node[:, 1:] * side
    assert (points >= low).all()
    assert (points <= low + side).all()


def test_no_points_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match="no points"):
        write(tmp_path / "cloud.copc.laz", [])
    assert [path.name for path in tmp_path.rglob("*")] == ["work"]
