"""The embedded retrieval descriptor: VLAD over RootSIFT features, no download."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.arrays import Float, UInt8
from ..records import WorkingImage
from .describer import LocalFeatures

WORDS = 64
TRAINING_FEATURES = 40_000
MIN_RESIDUAL = 1e-4  # of unit vectors, summed over the features of a word


class VladDescriber:
    """Vector of locally aggregated descriptors (Jegou et al. 2010), codebook learnt from the first images.

    Residuals are L2-normalised per word
    (Arandjelovic & Zisserman 2013), then the whole vector: D = 64 * 128.
    """

    def __init__(self, features: LocalFeatures, seed: int = 0) -> None:
        self.features = features
        self._seed = seed
        self._words: Float | None = None  # (WORDS, 128)

    def extract_features(self, images: Mapping[int, WorkingImage]) -> None:
        """Have the local features of new images extracted, all at once."""
        self.features.extract(images)

    def fit(self, images: Mapping[int, WorkingImage]) -> None:
        """Learn the visual words from the features of the first images."""
        import cv2

        rng = np.random.default_rng(self._seed)
        per_image = max(1, TRAINING_FEATURES // max(len(images), 1))
        samples = []
        for index in images:
            vectors = _unit(self.features.features_of(index, images[index]).descriptors)
            samples.append(vectors[rng.permutation(len(vectors))[:per_image]])
        training = np.vstack(samples) if samples else np.zeros((0, 128), np.float32)
        if len(training) < WORDS:  # next to no texture: any words do, retrieval will find nothing either way
            training = _unit(rng.uniform(1.0, 255.0, (WORDS, 128)))
        cv2.setRNGSeed(self._seed)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 15, 1e-4)
        labels = np.zeros((len(training), 1), np.int32)
        _, _, words = cv2.kmeans(training, WORDS, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
        self._words = np.asarray(words, np.float32)

    def learnt(self) -> Mapping[str, Float]:
        """Return the visual words."""
        return {} if self._words is None else {"words": self._words}

    def recall(self, learnt: Mapping[str, Float]) -> None:
        """Take the visual words of an earlier process."""
        self._words = np.asarray(learnt["words"], np.float32)

    def describe(self, index: int, image: WorkingImage) -> Float:
        """Return the L2-normalised descriptor (8192,) float32; zeros for an image in which it sees nothing."""
        if self._words is None:
            raise RuntimeError("describe() before fit()")
        vectors = _unit(self.features.features_of(index, image).descriptors)
        if len(vectors) == 0:
            return np.zeros(WORDS * 128, np.float32)
        # Nearest word by |v - w|^2 = 1 - 2 v.w + |w|^2.
        word = (vectors @ self._words.T - 0.5 * (self._words**2).sum(axis=1)).argmax(axis=1)
        residual = np.zeros((WORDS, 128), np.float32)
        for k in np.unique(word):
            members = vectors[word == k]
            residual[k] = members.sum(axis=0) - len(members) * self._words[k]
        length = np.linalg.norm(residual, axis=1, keepdims=True)
        # A residual as short as what rounding leaves tells nothing: its word counts as not seen.
        residual = np.where(length > MIN_RESIDUAL, residual / np.maximum(length, MIN_RESIDUAL), np.float32(0.0))
        flat = residual.ravel()
        return np.asarray(flat / max(float(np.linalg.norm(flat)), 1.0), np.float32)


def _unit(descriptors: Float | UInt8) -> Float:
    vectors = np.asarray(descriptors, np.float32)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
