"""Local features of working images."""

from __future__ import annotations

import numpy as np

from onthefly3r.backbones.features import extract_features
from onthefly3r.backbones.matching import mutual_matches


def test_image_without_texture_has_no_features_and_no_matches() -> None:
    none = extract_features(np.full((120, 160, 3), 90, np.uint8), max_features=500)
    assert none.pixels.shape == (0, 2) and none.descriptors.shape == (0, 128)
    some = extract_features(np.kron(np.eye(8)[:, :, None], np.full((20, 20, 3), 200)).astype(np.uint8), 500)
    assert len(some.pixels) > 0
    for pair in ((none, some), (some, none), (none, none)):
        assert mutual_matches(*pair).shape == (0, 2)


def test_features_lie_in_the_image() -> None:
    blocks = np.random.default_rng(1).integers(0, 255, (24, 32, 3), np.uint8)
    rgb = np.kron(blocks, np.ones((10, 10, 1), np.uint8))
    features = extract_features(rgb, max_features=50)
    assert len(features.pixels) == 50
    every = extract_features(rgb, max_features=5000)
    assert features.scales.min() >= np.sort(every.scales)[-50]
    assert (features.pixels >= 0.0).all() and (features.pixels <= (320.0, 240.0)).all()
    assert len(features.pixels) == len(features.scales) == len(features.angles) == len(features.descriptors)
