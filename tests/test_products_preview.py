from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from onthefly3r.products.las import CloudSummary, write_cloud
from onthefly3r.products.preview import PLACED, REJECTED, round_length, write_preview
from onthefly3r.products.rows import CameraRow
from onthefly3r.products.topview import TopView, Window
from onthefly3r.records import CloudTile

ORIGIN = np.array([576_700.0, 5_188_100.0, 160.0])


def write(path: Path, points: np.ndarray, rgb: np.ndarray) -> CloudSummary:
    zeros = np.zeros(len(points), np.int32)
    tile = CloudTile(points, rgb.astype(np.uint8), np.ones(len(points), np.float32), zeros, zeros, zeros + 1)
    return write_cloud(path, iter([tile]), None, 0.001)


def ground(rng: np.random.Generator, n: int = 60_000) -> np.ndarray:
    return ORIGIN + rng.uniform(0, 1, (n, 3)) * [80.0, 40.0, 0.5]


def near(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return np.argwhere((np.abs(image.astype(int) - colour) < 12).all(axis=2))


def test_the_topmost_point_gives_the_colour() -> None:
    view = TopView(Window(0, 0, 4, 2), 1.0)
    points = np.array([[0.5, 1.5, 1.0], [0.5, 1.5, 9.0], [0.5, 1.5, 5.0], [3.5, 0.5, 2.0], [9.0, 9.0, 9.0]])
    colours = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3], [4, 4, 4], [5, 5, 5]], np.uint8)
    view.add(points[:3], colours[:3])
    view.add(points[3:], colours[3:])
    view.add(points[:1], colours[2:3])  # lower than what is there
    assert view.rgb[..., 0].tolist() == [[2, 0, 0, 0], [0, 0, 0, 4]]
    assert np.argwhere(view.filled).tolist() == [[0, 0], [1, 3]]


@given(seed=st.integers(0, 2**32 - 1), parts=st.integers(1, 6))
def test_the_view_does_not_depend_on_the_order_of_points(seed: int, parts: int) -> None:
    rng = np.random.default_rng(seed)
    points, colours = rng.uniform(0, 5, (200, 3)), rng.integers(0, 256, (200, 3)).astype(np.uint8)
    whole, pieces = TopView(Window(0, 0, 5, 5), 1.0), TopView(Window(0, 0, 5, 5), 1.0)
    whole.add(points, colours)
    for part in np.array_split(rng.permutation(200), parts):
        pieces.add(points[part], colours[part])
    assert np.array_equal(whole.rgb, pieces.rgb)
    assert np.array_equal(whole.top, pieces.top)


def test_gaps_are_closed_and_outlines_stay() -> None:
    view = TopView(Window(0, 0, 9, 9), 1.0)
    view.rgb[3:6, 3:6], view.top[3:6, 3:6] = 100, 1.0
    view.rgb[4, 4], view.top[4, 4] = 0, -np.inf
    view.close_gaps()
    assert view.rgb[4, 4].tolist() == [100, 100, 100]
    assert not view.filled[:2].any()
    assert not view.filled[2, 2]


def test_stray_points_do_not_widen_the_window(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.permutation(np.concatenate([ground(rng), ORIGIN + rng.normal(0, 5_000, (60, 3))]))
    window = Window(*write(tmp_path / "c.laz", points, np.full((len(points), 3), 90)).window)
    assert window.width == pytest.approx(80, abs=2)
    assert window.height == pytest.approx(40, abs=2)


@given(longest=st.floats(1e-3, 1e5))
def test_round_lengths(longest: float) -> None:
    length = round_length(longest)
    assert longest / 2.5 - 1e-9 <= length <= longest * (1 + 1e-9)
    mantissa = length / 10.0 ** np.floor(np.log10(length) + 1e-9)
    assert min(abs(mantissa - step) for step in (1, 2, 5)) < 1e-6


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_picture_shows_cloud_and_cameras_where_they_are(tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(0)
    points = ground(rng)
    colours = np.full((len(points), 3), (60, 120, 40))
    colours[points[:, 0] > ORIGIN[0] + 40] = (200, 180, 160)  # east half
    cloud = write(tmp_path / f"cloud.{suffix}", points, colours)
    rows = [CameraRow(f"{k}", k + 1, "placed", x=ORIGIN[0] + 10 + 12 * k, y=ORIGIN[1] + 20, z=200.0) for k in range(6)]
    rows.append(CameraRow("x", 7, "rejected", gps_x=ORIGIN[0] + 70, gps_y=ORIGIN[1] + 35))
    rows.append(CameraRow("nowhere", 8, "rejected"))
    write_preview(tmp_path / "preview.png", cloud, rows, "A survey", georeferenced=True)

    with Image.open(tmp_path / "preview.png") as picture:
        image = np.asarray(picture)
    assert 1_590 <= image.shape[1] <= 1_610
    west, east = near(image, (60, 120, 40)), near(image, (200, 180, 160))
    assert len(west) > 100_000
    assert len(east) > 100_000
    assert west[:, 1].mean() < east[:, 1].mean()
    scale = 1_600 / (80 * (1 + 2 * 0.04))  # px per m
    left = near(image, PLACED)[:, 1].min()
    assert left == pytest.approx((10 + 80 * 0.04) * scale, abs=25)
    crosses = near(image, REJECTED)
    assert crosses[:, 1].min() > image.shape[1] / 2
    in_map = crosses[crosses[:, 0] < image.shape[0] - 84]
    assert in_map[:, 0].mean() < near(image, PLACED)[:, 0].mean()  # further north
    assert [p.name for p in tmp_path.glob(".*")] == []


@pytest.mark.parametrize(("beyond_m", "shown"), [(60.0, True), (120.0, False)])
def test_rejected_photographs_around_the_map_are_in_the_picture(tmp_path: Path, beyond_m: float, shown: bool) -> None:
    points = ground(np.random.default_rng(0))
    cloud = write(tmp_path / "cloud.laz", points, np.full((len(points), 3), 90))
    rows = [CameraRow("a", 1, "placed", x=ORIGIN[0] + 40, y=ORIGIN[1] + 20, z=200.0)]
    rows.append(CameraRow("b", 2, "rejected", gps_x=ORIGIN[0] + 80 + beyond_m, gps_y=ORIGIN[1] + 20))
    write_preview(tmp_path / "preview.png", cloud, rows, "", georeferenced=True)
    with Image.open(tmp_path / "preview.png") as picture:
        crosses = near(np.asarray(picture), REJECTED)
        in_map = crosses[crosses[:, 0] < picture.size[1] - 84]  # the legend has one too
    assert bool(len(in_map)) == shown
    if shown:
        assert picture.size[0] * 0.9 < in_map[:, 1].mean() < picture.size[0]


def test_one_camera_and_a_tiny_cloud(tmp_path: Path) -> None:
    cloud = write(tmp_path / "c.laz", ORIGIN + np.zeros((1, 3)), np.full((1, 3), 90))
    rows = [CameraRow("a", 1, "placed", x=ORIGIN[0], y=ORIGIN[1], z=5.0)]
    write_preview(tmp_path / "preview.png", cloud, rows, "", georeferenced=False, unit="map units")
    with Image.open(tmp_path / "preview.png") as picture:
        assert picture.size[0] >= 640
