"""Local features of working images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from onthefly3r.features.extraction import FeatureStore, extract_features
from onthefly3r.features.matching import mutual_matches
from onthefly3r.geometry.arrays import Float, UInt8
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.records import Features, WorkingImage

CHECKED = np.kron(np.eye(8)[:, :, None], np.full((20, 20, 3), 200)).astype(np.uint8)


def blocks(seed: int, width: int = 320, height: int = 240) -> UInt8:
    cells = np.random.default_rng(seed).integers(0, 255, (height // 10, width // 10, 3), np.uint8)
    return np.kron(cells, np.ones((10, 10, 1), np.uint8))


def same(first: Features, second: Features) -> bool:
    return bool(np.array_equal(first.pixels, second.pixels) and np.array_equal(first.descriptors, second.descriptors))


def test_image_without_texture_has_no_features_and_no_matches() -> None:
    none, some = extract_features([np.full((120, 160, 3), 90, np.uint8), CHECKED], 500, threads=2)
    assert none.pixels.shape == (0, 2) and none.descriptors.shape == (0, 128)
    assert len(some.pixels) > 0
    for pair in ((none, some), (some, none), (none, none)):
        assert mutual_matches(*pair).shape == (0, 2)


def texture(contrast: float, width: int = 800, height: int = 600, seed: int = 1) -> Float:
    """Return smooth noise about mid grey, its standard deviation in grey levels of 256."""
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(height, width)), (0, 0), 2.0)
    return np.asarray(120.0 + smooth * contrast / smooth.std())


def as_image(grey: Float, noise: float = 0.0, seed: int = 2) -> UInt8:
    noisy = grey + np.random.default_rng(seed).normal(size=grey.shape) * noise
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def extracted(rgb: UInt8, count: int) -> Features:
    (features,) = extract_features([rgb], count, threads=1)
    return features


def filled_cells(features: Features, side_px: int = 100) -> int:
    return len(np.unique((features.pixels // side_px).astype(int), axis=0))


def test_features_lie_in_the_image() -> None:
    features = extracted(blocks(1), 50)
    assert len(features.pixels) == 50
    assert (features.pixels >= 0.0).all() and (features.pixels <= (320.0, 240.0)).all()
    assert len(features.pixels) == len(features.scales) == len(features.angles) == len(features.descriptors)
    assert features.descriptors.shape == (50, 128) and features.descriptors.dtype == np.uint8
    lengths = np.linalg.norm(features.descriptors.astype(float), axis=1)
    np.testing.assert_allclose(lengths, 512.0, rtol=0.01)


def test_a_blob_is_found_at_its_centre_and_scale() -> None:
    """Pixels count from the corner of the first one: a blob about the centre of pixel (80, 50) lies at (80.5, 50.5)."""
    y, x = np.mgrid[:120, :160]
    for sigma in (2.5, 4.0, 8.0):
        grey = 60.0 + 150.0 * np.exp(-((x - 80.0) ** 2 + (y - 50.0) ** 2) / (2.0 * sigma**2))
        features = extracted(as_image(grey), 100)
        nearest = np.linalg.norm(features.pixels - (80.5, 50.5), axis=1).argmin()
        np.testing.assert_allclose(features.pixels[nearest], (80.5, 50.5), atol=0.05)
        assert features.scales[nearest] == pytest.approx(sigma, rel=0.2)


def test_weak_texture_has_features_everywhere_and_noise_has_none() -> None:
    """Crops, snow and sand: a texture of one and a half grey levels, with the noise of a sensor on it."""
    faint = extracted(as_image(texture(1.5), noise=1.0), 1500)
    assert len(faint.pixels) == 1500
    assert filled_cells(faint) == 48
    assert len(extracted(as_image(np.full((600, 800), 120.0), noise=1.0), 1500).pixels) == 0


def test_strong_texture_takes_nothing_from_weak_texture_beside_it() -> None:
    grey = texture(1.5)
    grey[:, :600] = texture(40.0)[:, :600]
    features = extracted(as_image(grey), 1200)
    faint = np.count_nonzero(features.pixels[:, 0] > 600.0)
    assert 0.2 * 1200 <= faint <= 0.3 * 1200  # a quarter of the image
    assert filled_cells(features) == 48


def test_the_first_features_are_spread_as_all_are() -> None:
    features = extracted(as_image(texture(20.0)), 2000)
    first = Features(features.pixels[:400], features.scales[:400], features.angles[:400], features.descriptors[:400])
    assert filled_cells(first) == 48
    alone = extracted(as_image(texture(20.0)), 400)
    assert same(first, alone)


def rendered(plane: Float, plane_from_image: Float, width: int, height: int) -> Float:
    """Return an image of a plane, sampled exactly: OpenCV's warping is off by a twentieth of a pixel."""
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))])
    x, y, z = np.tensordot(plane_from_image, pixels, axes=1)
    return np.asarray(map_coordinates(plane, [y / z, x / z], order=3))


def test_features_follow_the_ground_when_it_is_seen_from_elsewhere() -> None:
    """Two images of one plane with noise of their own, the second turned, nearer by a tenth and in perspective."""
    plane = map_coordinates(texture(25.0, 900, 900), np.mgrid[:1800, :1800] / 2.0, order=3)
    turn = np.radians(140.0)
    plane_from_first = np.array([[2.0, 0.0, 500.0], [0.0, 2.0, 600.0], [0.0, 0.0, 1.0]])
    plane_from_second = np.eye(3)
    plane_from_second[:2, :2] = 1.8 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    plane_from_second[:2, 2] = (900.0, 900.0) - plane_from_second[:2, :2] @ (200.0, 150.0)
    plane_from_second = plane_from_second @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1e-4, -5e-5, 1.0]])
    seen = [
        extracted(as_image(rendered(plane, plane_from_image, 400, 300), noise=1.0, seed=k), 1500)
        for k, plane_from_image in enumerate((plane_from_first, plane_from_second))
    ]
    matches = mutual_matches(*seen)
    first = seen[0].pixels[matches[:, 0]].astype(float) - 0.5  # the renderings count from pixel centres
    expected = cv2.perspectiveTransform(first[None], np.linalg.inv(plane_from_second) @ plane_from_first)[0]
    off_px = seen[1].pixels[matches[:, 1]] - 0.5 - expected
    right = np.linalg.norm(off_px, axis=1) < 2.0
    assert np.count_nonzero(right) > 300 and right.mean() > 0.97
    assert np.median(np.abs(off_px[right])) < 0.07
    assert np.abs(np.median(off_px[right], axis=0)).max() < 0.02


def test_features_do_not_depend_on_the_number_of_threads() -> None:
    images = [blocks(seed) for seed in range(6)] + [as_image(texture(20.0))]
    alone, together = (extract_features(images, 1000, threads) for threads in (1, 4))
    for first, second in zip(alone, together, strict=True):
        assert same(first, second)
        assert np.array_equal(first.angles, second.angles) and np.array_equal(first.scales, second.scales)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (23, 400), (40, 30), (900, 26)])
def test_small_and_narrow_images_are_no_error(width: int, height: int) -> None:
    rgb = np.random.default_rng(3).integers(0, 255, (height, width, 3), np.uint8)
    features = extracted(rgb, 500)
    assert (features.pixels <= (width, height)).all()


def test_an_image_turned_by_a_right_angle_has_its_features_turned() -> None:
    rgb = blocks(2)
    upright, turned = extract_features([rgb, np.rot90(rgb).copy()], 2000, threads=1)
    matches = mutual_matches(upright, turned)
    assert len(matches) > 0.5 * len(upright.pixels)
    first, second = upright.pixels[matches[:, 0]], turned.pixels[matches[:, 1]]
    off_px = np.abs(second - np.column_stack([first[:, 1], 320.0 - first[:, 0]])).max(axis=1)
    assert np.median(off_px) < 0.1
    turn = (turned.angles[matches[:, 1]] - upright.angles[matches[:, 0]])[off_px < 1.0]
    assert abs(np.median(np.angle(np.exp(1j * (turn + np.pi / 2))))) < 0.02  # y points down


def test_images_of_several_sizes_are_extracted_together_as_they_are_alone(tmp_path: Path) -> None:
    rgb = {3: blocks(3), 5: blocks(5, 200, 300), 8: CHECKED, 9: blocks(9)}
    images = {i: WorkingImage(None, pixels, PixelMap(1.0, 1.0)) for i, pixels in rgb.items()}  # type: ignore[arg-type]
    store = FeatureStore(tmp_path / "Flug süd", 400, threads=2)
    store.extract(images)
    for index, image in images.items():
        (alone,) = extract_features([image.rgb], 400, threads=1)
        assert same(store.load(index), alone)
        assert same(FeatureStore(tmp_path / "Flug süd", 400).load(index), alone)  # from disk


def test_features_that_are_there_are_not_extracted_again(tmp_path: Path) -> None:
    image = WorkingImage(None, blocks(3), PixelMap(1.0, 1.0))  # type: ignore[arg-type]
    store = FeatureStore(tmp_path, 400)
    first = store.features_of(0, image)
    other = WorkingImage(None, blocks(4), PixelMap(1.0, 1.0))  # type: ignore[arg-type]
    assert same(store.features_of(0, other), first)
    store.extract({0: other})
    assert same(store.load(0), first)


def test_more_features_begin_with_those_that_are_known(tmp_path: Path) -> None:
    image = WorkingImage(None, as_image(texture(20.0)), PixelMap(1.0, 1.0))  # type: ignore[arg-type]
    store = FeatureStore(tmp_path, 400)
    few, more = store.features_of(0, image), store.more().features_of(0, image)
    assert len(few.pixels) == 400 and len(more.pixels) == 800
    assert np.array_equal(more.pixels[:400], few.pixels) and np.array_equal(more.descriptors[:400], few.descriptors)
    assert same(store.features_of(0, image), few) and store.more() is store.more()
