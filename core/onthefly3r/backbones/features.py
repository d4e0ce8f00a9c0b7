"""Local features of working images, extracted once per image and kept on disk behind a small cache."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.arrays import UInt8
from ..records import Features, WorkingImage
from .colmap import load_pycolmap

CACHED_IMAGES = 128  # about 0.6 MB each


def extract_features(rgb: UInt8, max_features: int, extractor: Any = None) -> Features:
    """Return RootSIFT features (Lowe 2004, Arandjelovic & Zisserman 2012) of an RGB image (H, W, 3).

    The first octave is the image itself, not its double: on drone photographs reduced to working size the
    doubled octave costs four times as much and adds few matches.
    """
    import cv2

    pycolmap = load_pycolmap()

    extractor = extractor or new_extractor(max_features)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = extractor.extract(pycolmap.Bitmap.from_array(gray))
    table = np.zeros((0, 4), np.float32)  # what an image without any texture has
    if len(keypoints) > 0:
        table = np.asarray(pycolmap.keypoints_to_matrix(keypoints), np.float32)
    # The extractor stops at whole levels of the scale space and may give twice as many.
    largest = np.argsort(-table[:, 2], kind="stable")[:max_features]
    table = table[largest]
    return Features(
        pixels=table[:, :2],
        scales=table[:, 2],
        angles=table[:, 3],
        descriptors=np.asarray(descriptors.data, np.uint8).reshape(-1, 128)[largest],
    )


def new_extractor(max_features: int) -> Any:
    """Return a single-threaded SIFT extractor; one per thread, as it is not safe to share."""
    pycolmap = load_pycolmap()

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.max_num_features = max_features
    options.sift.first_octave = 0
    return pycolmap.FeatureExtractor.create(options)


class FeatureStore:
    """Features by shot index: extracted on first demand, kept on disk, the last ones in memory; thread-safe."""

    def __init__(self, folder: Path, max_features: int) -> None:
        self._folder = folder
        self._max_features = max_features
        self._recent: OrderedDict[int, Features] = OrderedDict()
        self._lock = threading.Lock()
        self._per_thread = threading.local()

    def features_of(self, index: int, image: WorkingImage) -> Features:
        """Return the features of one image, extracting them when they are not on disk yet."""
        with self._lock:
            known = self._recent.get(index)
        if known is not None:
            return known
        path = self._path(index)
        if not path.exists():
            if not hasattr(self._per_thread, "extractor"):
                self._per_thread.extractor = new_extractor(self._max_features)
            features = extract_features(image.rgb, self._max_features, self._per_thread.extractor)
            self._write(path, features)
            self._remember(index, features)
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
        with np.load(path, allow_pickle=False) as stored:
            features = Features(stored["pixels"], stored["scales"], stored["angles"], stored["descriptors"])
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
