"""Local features of working images, extracted once per image and kept on disk behind a small cache."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files.array_file import ArrayFile
from ..geometry.arrays import UInt8
from ..records import Features, WorkingImage
from .keypoints import find_keypoints, scale_space
from .rootsift import describe

CACHED_IMAGES = 128  # about 0.6 MB each


def extract_features(images: Sequence[UInt8], max_features: int, threads: int) -> list[Features]:
    """Return RootSIFT features (Lowe 2004, Arandjelovic & Zisserman 2012) of RGB images (H, W, 3).

    They come best spread first: any so many of the first are spread over the image as all are.
    """
    with ThreadPoolExecutor(max(1, threads)) as pool:
        return list(pool.map(lambda rgb: _features(rgb, max_features), images))


def _features(rgb: UInt8, max_features: int) -> Features:
    import cv2

    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    octaves = scale_space(grey)
    height, width = grey.shape
    keypoints = find_keypoints(octaves, (height, width), max_features)
    angles, descriptors = describe(octaves, keypoints)
    # Pixels count from the corner of the first one, as everywhere else.
    return Features(keypoints.pixels() + np.float32(0.5), keypoints.scales(), angles, descriptors)


class FeatureStore:
    """Features by shot index: extracted on first demand, kept on disk, the last ones in memory; thread-safe."""

    def __init__(self, folder: Path, max_features: int, threads: int = 0) -> None:
        """`threads` of the processor, 0 for all."""
        self._folder = folder
        self._max_features = max_features
        self._threads = threads or os.cpu_count() or 1
        self._recent: OrderedDict[int, Features] = OrderedDict()
        self._lock = threading.Lock()
        self._more: FeatureStore | None = None

    def more(self) -> FeatureStore:
        """Return a store of twice as many features; the first of them are those of this one, by the same numbers."""
        with self._lock:
            if self._more is None:
                self._more = FeatureStore(self._folder / "more", 2 * self._max_features, self._threads)
            return self._more

    def extract(self, images: Mapping[int, WorkingImage]) -> None:
        """Extract the features of several images at once, those that are not on disk yet."""
        missing = [index for index in images if not self._path(index).exists()]
        if not missing:
            return
        found = extract_features([images[index].rgb for index in missing], self._max_features, self._threads)
        for index, features in zip(missing, found, strict=True):
            self._write(self._path(index), features)
            self._remember(index, features)

    def features_of(self, index: int, image: WorkingImage) -> Features:
        """Return the features of one image, extracting them when they are not on disk yet."""
        try:
            return self.load(index)
        except KeyError:
            self.extract({index: image})
            return self.load(index)

    def load(self, index: int) -> Features:
        """Return features that were extracted before; raises `KeyError` when they were not."""
        with self._lock:
            known = self._recent.get(index)
            if known is not None:
                self._recent.move_to_end(index)
                return known
        path = self._path(index)
        if not path.exists():
            raise KeyError(index)
        try:
            with ArrayFile(path) as stored:
                features = Features(stored["pixels"], stored["scales"], stored["angles"], stored["descriptors"])
        except InputError:  # a power cut left it half: it is made again
            path.unlink(missing_ok=True)
            raise KeyError(index) from None
        self._remember(index, features)
        return features

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.npz"

    @staticmethod
    def _write(path: Path, features: Features) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".part.npz")
        np.savez(
            temporary,
            pixels=features.pixels,
            scales=features.scales,
            angles=features.angles,
            descriptors=features.descriptors,
        )
        temporary.replace(path)

    def _remember(self, index: int, features: Features) -> None:
        with self._lock:
            self._recent[index] = features
            self._recent.move_to_end(index)
            while len(self._recent) > CACHED_IMAGES:
                self._recent.popitem(last=False)
