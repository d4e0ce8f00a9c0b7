"""The second dense pass: each stage on exact depth maps of a flat block, and all of them on its pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flat_block import ALTITUDE, FOCAL, HEIGHT, WIDTH, flat_block, ground_depth
from onthefly3r.cloud.alignment import Comparison, DepthTies, align, basis, compare, factors
from onthefly3r.cloud.averaging import average
from onthefly3r.cloud.colour import gains, harmonised
from onthefly3r.cloud.figures import DenseFigures
from onthefly3r.cloud.layers import LayerCollector
from onthefly3r.cloud.maps import MapFolder
from onthefly3r.cloud.partners import Overlaps
from onthefly3r.cloud.second_pass import second_pass
from onthefly3r.cloud.views import PixelTransfer, View, pinhole
from onthefly3r.errors import Cancelled
from onthefly3r.geometry.camera import Camera
from onthefly3r.records import CloudTile

GSD = ALTITUDE / FOCAL


def nothing(stage: str, done: int, total: int) -> None:
    """A checkpoint that lets everything pass."""


def all_pairs(views: dict[int, View], depths: dict[int, np.ndarray]) -> list[Comparison]:
    found = [compare(i, j, views, (depths[i], depths[j]), step_px=6) for i in views for j in views if i != j]
    return [item for item in found if item is not None]


def test_a_pixel_is_transferred_to_where_its_point_is_seen() -> None:
    first, second, *_ = flat_block().values()
    transfer = PixelTransfer.between(first, second)
    point = first.points[:20].astype(float)
    in_first, in_second = (view.level_from_cam.inverse().apply(point) for view in (first, second))
    pixels = np.column_stack([first.grid.project(in_first), np.ones(20)])
    u, v, z = transfer.matrix @ pixels.T * in_first[:, 2] + transfer.offset[:, None]
    np.testing.assert_allclose(np.column_stack([u / z, v / z]), second.grid.project(in_second), atol=1e-6)
    np.testing.assert_allclose(z, in_second[:, 2], rtol=1e-9)


def test_the_pinhole_grid_sees_all_that_a_distorted_camera_sees() -> None:
    camera = Camera(400, 300, 300.0, 302.0, 205.0, 148.0, (-0.12, 0.02, 5e-4, -3e-4))
    grid = pinhole(camera)
    corners = np.array([[0.0, 0.0], [400.0, 0.0], [0.0, 300.0], [400.0, 300.0], [200.0, 0.0], [0.0, 150.0]])
    pixels = grid.project(camera.rays(corners))
    assert (pixels >= -1e-6).all() and (pixels <= (grid.width + 1e-6, grid.height + 1e-6)).all()
    assert grid.fx == grid.fy and not any(grid.distortion)


def test_partners_see_the_same_ground_at_a_good_angle() -> None:
    views = flat_block(columns=12, rows=1, step=3.0)
    partners = Overlaps(views).partners(10, 3)
    assert partners[0] in {12, 13, 14}  # 6 to 12 m at 40 m: near 14 degrees; the next photograph is too near
    assert 21 not in partners  # 33 m away: hardly any overlap
    assert 10 not in partners


def test_depth_maps_are_laid_on_each_other_and_on_the_tracks() -> None:
    views = flat_block()
    rng = np.random.default_rng(1)
    terms = {index: 0.004 * rng.standard_normal(6) + np.array([0.006, 0, 0, 0, 0, 0]) for index in views}
    depths = {i: ground_depth(view) / factors(terms[i], WIDTH, HEIGHT) for i, view in views.items()}
    place = rng.uniform(-1, 1, (60, 2))
    ties = {i: DepthTies(place, basis(place) @ terms[i]) for i in views}  # what the adjustment knows
    aligned = align(list(views), all_pairs(views, depths), ties)
    assert aligned.before > 3e-3
    assert aligned.after < 3e-4
    for index, view in views.items():
        restored = depths[index] * factors(aligned.terms[index], WIDTH, HEIGHT)
        assert np.abs(restored / ground_depth(view) - 1.0).max() < 1.5e-3


def test_without_tracks_the_maps_agree_and_keep_their_mean_depth() -> None:
    views = flat_block()
    rng = np.random.default_rng(2)
    terms = {index: 0.003 * rng.standard_normal(6) for index in views}
    depths = {i: ground_depth(view) * factors(terms[i], WIDTH, HEIGHT) for i, view in views.items()}
    aligned = align(list(views), all_pairs(views, depths))
    assert aligned.after < 0.15 * aligned.before


def test_averaging_takes_noise_away_and_knows_who_agrees() -> None:
    views = flat_block(columns=3, rows=3, step=4.0)
    rng = np.random.default_rng(3)
    noisy = {
        i: ground_depth(v) * (1 + 0.002 * rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32))
        for i, v in views.items()
    }
    centre = 14
    own = noisy[centre].copy()
    own[100:110, 150:160] *= 0.8  # floats in the air
    own[120:130, 150:160] *= 1.2  # below the ground: hidden from the others
    own[140:150, 150:160] = 0.0
    found = average(views[centre], own, [(views[j], noisy[j]) for j in views if j != centre])
    inner = (slice(60, 95), slice(60, 260))
    error = np.abs(found.depth / ground_depth(views[centre]) - 1.0)[inner]
    assert np.median(error) < 0.5 * 0.002 * 0.674  # of the nine, most agree
    assert np.median(found.support[inner]) >= 7
    assert (found.against[100:110, 150:160] > found.support[100:110, 150:160]).all()
    assert (found.against[120:130, 150:160] == 0).all() and (found.support[120:130, 150:160] == 0).all()
    assert (found.depth[140:150, 150:160] == 0.0).all()


def test_every_point_is_left_to_one_photograph() -> None:
    """Of photographs that agree about a point, exactly one has no senior, and it sees the point closest to its axis."""
    views = flat_block(columns=3, rows=1, step=4.0)
    exact = {i: ground_depth(v) for i, v in views.items()}
    shares = []
    for i, view in views.items():
        found = average(view, exact[i], [(views[j], exact[j]) for j in views if j != i])
        shares.append((found.seniors == 0).mean())
    assert sum(shares) == pytest.approx(1.0 + 2 * 4.0 / (WIDTH * GSD), abs=0.05)  # what the block covers, in pictures


def test_gains_bring_the_block_to_one_exposure() -> None:
    views = flat_block()
    truth = {index: np.array([1.0, 1.1, 0.9]) ** ((index % 3) - 1) for index in views}
    comparisons = [
        Comparison(i, j, np.zeros((9, 2)), np.zeros((9, 2)), np.zeros(9), np.tile(np.log(truth[i] / truth[j]), (9, 1)))
        for i in views
        for j in views
        if i < j
    ]
    found = gains(list(views), comparisons)
    for index in views:
        np.testing.assert_allclose(found[index] * truth[index], 1.0, atol=0.01)
    assert harmonised(np.full((1, 3), 200, np.uint8), np.array([0.5, 1.0, 2.0])).tolist() == [[100, 200, 255]]


def test_layer_spread_is_the_distance_of_sheets() -> None:
    rng = np.random.default_rng(4)
    collector = LayerCollector(1.0, 100.0)
    for source, height in ((1, 0.0), (2, 0.1), (3, 0.04)):
        xy = rng.uniform(0, 10, (20_000, 2))
        slope = 0.3 * xy[:, 0]
        collector.add(source, np.column_stack([xy, slope + height + 0.01 * rng.standard_normal(len(xy))]))
    spread = collector.spread()
    assert spread.cells == 100
    assert spread.median == pytest.approx(0.1, abs=0.005)
    assert LayerCollector(1.0, 100.0).spread().cells == 0


def test_maps_stay_on_disk_and_go_at_the_end(tmp_path: Path) -> None:
    kept = tmp_path / "mine.npy"
    kept.write_bytes(b"not ours")
    with MapFolder(tmp_path, cache_bytes=1000) as maps:
        for index in range(5):
            maps.write("depth", index, np.full(100, index, np.float32))
        assert maps.read("depth", 0)[0] == 0.0  # long out of memory
        assert maps._held <= 1000
        maps.forget("depth")
        with pytest.raises(FileNotFoundError):
            maps.read("depth", 4)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.npy"]


def run(views: dict[int, View], work: Path, threads: int = 1) -> tuple[list[CloudTile], DenseFigures]:
    figures = DenseFigures("standard")
    return list(second_pass(views, work, nothing, threads, figures)), figures


def test_a_flat_block_becomes_flat_ground_whatever_the_threads(tmp_path: Path) -> None:
    views = flat_block(columns=4, rows=2, step=7.0, folder=tmp_path)
    tiles, figures = run(views, tmp_path / "work")
    points = np.concatenate([tile.points for tile in tiles])
    confidence = np.concatenate([tile.confidence for tile in tiles])
    certain = confidence >= 0.8
    assert certain.mean() > 0.6
    assert np.abs(points[certain, 2]).mean() < 0.25 * GSD
    assert np.quantile(np.abs(points[certain, 2]), 0.99) < 1.5 * GSD
    for tile in tiles:
        assert (tile.views[tile.confidence >= 0.8] >= 3).all()  # certain is what three photographs agree on
    assert figures.photographs == 8 and figures.unreadable == []
    assert figures.averaged.median < figures.single.median
    assert not list((tmp_path / "work").iterdir())
    again, _ = run(views, tmp_path / "work", threads=2)
    for one, other in zip(tiles, again, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.rgb, other.rgb)


def test_a_photograph_that_is_gone_is_named_and_harms_no_other(tmp_path: Path) -> None:
    views = flat_block(columns=3, rows=1, step=7.0, folder=tmp_path)
    views[11].shot.path.unlink()
    tiles, figures = run(views, tmp_path / "work")
    assert figures.unreadable == ["01.png"]
    assert {int(tile.source[0]) for tile in tiles} == {10, 12}
    assert "01.png" in figures.warnings()[0]


def test_cancelling_leaves_nothing_behind(tmp_path: Path) -> None:
    views = flat_block(columns=3, rows=1, step=7.0, folder=tmp_path)

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "matching depths" and done == 2:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        list(second_pass(views, tmp_path / "work", stop, 2, DenseFigures("standard")))
    assert not list((tmp_path / "work").iterdir())
