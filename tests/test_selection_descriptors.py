"""The embedded descriptor on places whose features are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from onthefly3r.records import Features, WorkingImage
from onthefly3r.selection.descriptors import WORDS, VladDescriber


def features(place: int, seed: int, count: int = 80) -> Features:
    """The features of a place as one image sees them, a little noisy and in an order of its own."""
    rng = np.random.default_rng(seed)
    true = np.random.default_rng((1, place)).uniform(0.0, 255.0, (count, 128))
    vectors = rng.permutation(np.repeat(true, 3, axis=0)) + 6.0 * rng.standard_normal((3 * count, 128))
    n = len(vectors)
    descriptors = np.clip(vectors, 0, 255).astype(np.uint8)
    return Features(np.zeros((n, 2), np.float32), np.ones(n, np.float32), np.zeros(n, np.float32), descriptors)


@dataclass(frozen=True)
class Known:
    """Features that need no image."""

    of: dict[int, Features]

    def extract(self, images: Mapping[int, WorkingImage]) -> None:
        raise AssertionError("they are there")

    def features_of(self, index: int, image: WorkingImage) -> Features:
        return self.of[index]


def describer(of: dict[int, Features]) -> VladDescriber:
    return VladDescriber(Known(of))


def images(of: dict[int, Features]) -> dict[int, WorkingImage]:
    return dict.fromkeys(of)  # type: ignore[arg-type]  # the features are looked up by index


@pytest.fixture(scope="module")
def places() -> dict[int, Features]:
    """Images 2k and 2k + 1 show the same place."""
    return {i: features(i // 2, seed=i) for i in range(12)}


def test_images_of_one_place_are_most_alike(places: dict[int, Features]) -> None:
    describe = describer(places)
    describe.fit(images(places))
    vectors = np.stack([describe.describe(i, None) for i in places])  # type: ignore[arg-type]
    assert vectors.dtype == np.float32 and vectors.shape == (12, WORDS * 128)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    similarity = vectors @ vectors.T - 2.0 * np.eye(12)
    assert [int(s.argmax()) for s in similarity] == [i ^ 1 for i in range(12)]


def test_the_codebook_is_the_same_each_time(places: dict[int, Features]) -> None:
    twice = []
    for _ in range(2):
        describe = describer(places)
        describe.fit(images(places))
        twice.append(describe.describe(3, None))  # type: ignore[arg-type]
    np.testing.assert_array_equal(*twice)


def test_images_without_texture_stop_nothing() -> None:
    empty = {0: features(0, 0, count=0), 1: features(1, 1, count=4)}
    describe = describer(empty)
    with pytest.raises(RuntimeError, match="before fit"):
        describe.describe(0, None)  # type: ignore[arg-type]
    describe.fit(images(empty))
    assert not describe.describe(0, None).any()  # type: ignore[arg-type]
    assert np.linalg.norm(describe.describe(1, None)) == pytest.approx(1.0, abs=1e-5)  # type: ignore[arg-type]


def test_few_features_give_no_nan() -> None:
    """As many features as words: each is a word of its own and leaves no residual."""
    vectors = np.random.default_rng(0).integers(0, 255, (WORDS, 128)).astype(np.uint8)
    few = Features(np.zeros((WORDS, 2), np.float32), np.ones(WORDS, np.float32), np.zeros(WORDS, np.float32), vectors)
    empty = Features(few.pixels[:0], few.scales[:0], few.angles[:0], few.descriptors[:0])
    of = {0: few, 1: empty, 2: features(0, 0)}
    describe = describer(of)
    describe.fit({0: None})  # type: ignore[dict-item]
    for index in of:
        assert np.isfinite(describe.describe(index, None)).all()  # type: ignore[arg-type]


def test_an_image_whose_features_are_words_themselves_is_like_no_other() -> None:
    """Few features, all the same: each lies on its word and leaves no residual."""
    one = features(0, 0, count=1)
    same = np.repeat(one.descriptors[:1], 100, axis=0)
    every = Features(np.zeros((100, 2), np.float32), np.ones(100, np.float32), np.zeros(100, np.float32), same)
    known = {0: every, 1: every}
    describe = describer(known)
    describe.fit(images(known))
    assert not describe.describe(0, None).any()  # type: ignore[arg-type]
