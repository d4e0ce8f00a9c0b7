"""Local features of working images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from onthefly3r.features.extraction import FeatureStore, extract_features
from onthefly3r.features.matching import mutual_matches
from onthefly3r.geometry.arrays import UInt8
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


def test_features_lie_in_the_image() -> None:
    (features,) = extract_features([blocks(1)], 50, threads=1)
    assert len(features.pixels) == 50
    (every,) = extract_features([blocks(1)], 5000, threads=1)
    assert features.scales.min() >= np.sort(every.scales)[-50]
    assert (features.pixels >= 0.0).all() and (features.pixels <= (320.0, 240.0)).all()
    assert len(features.pixels) == len(features.scales) == len(features.angles) == len(features.descriptors)


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
