"""Local features of working images, extracted once per image and kept on disk behind a small cache."""

from __future__ import annotations

import os
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..files.array_file import ArrayFile
from ..geometry.arrays import Float, UInt8
from ..records import Features, WorkingImage
from .pycolmap_module import load_pycolmap

CACHED_IMAGES = 128  # about 0.6 MB each


def extract_features(images: Sequence[UInt8], max_features: int, threads: int) -> list[Features]:
    """Return RootSIFT features (Lowe 2004, Arandjelovic & Zisserman 2012) of RGB images (H, W, 3).

    The first octave is the image itself, not its double: on drone photographs reduced to working size the
    doubled octave costs four times as much and adds few matches.
    """
    import cv2

    pycolmap = load_pycolmap()

    # Through files, because only this way in lets several threads extract at once: `FeatureExtractor.extract` keeps
    # the interpreter locked. The names and the folder's are plain ASCII wherever the system's own temporary folder is.
    with tempfile.TemporaryDirectory(prefix="onthefly3r-") as folder:
        names = [f"{number:06d}.pgm" for number in range(len(images))]
        for name, rgb in zip(names, images, strict=True):
            height, width = rgb.shape[:2]
            grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
            (Path(folder) / name).write_bytes(b"P5 %d %d 255\n" % (width, height) + grey.tobytes())
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = threads
        options.max_image_size = max(max(rgb.shape) for rgb in images)  # as it is, never reduced
        options.sift.max_num_features = max_features
        options.sift.first_octave = 0
        path = Path(folder) / "features.db"
        pycolmap.extract_features(
            path,
            folder,
            image_names=names,
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        database = pycolmap.Database.open(path)
        try:
            image_id = {image.name: image.image_id for image in database.read_all_images()}
            return [
                _features(
                    database.read_keypoints(image_id[name]),
                    database.read_descriptors(image_id[name]).data,
                    max_features,
                )
                for name in names
            ]
        finally:
            database.close()  # before the folder goes


def _features(keypoints: Float, descriptors: UInt8, max_features: int) -> Features:
    """Return the largest features; keypoints (N, 6) are x, y and the affine shape by rows."""
    shape = np.asarray(keypoints, np.float32).reshape(-1, 6)
    scales = np.hypot(shape[:, 2], shape[:, 4])
    # The extractor stops at whole levels of the scale space and may give twice as many.
    largest = np.argsort(-scales, kind="stable")[:max_features]
    return Features(
        pixels=shape[largest, :2],
        scales=scales[largest],
        angles=np.arctan2(shape[largest, 4], shape[largest, 2]),
        descriptors=np.asarray(descriptors, np.uint8).reshape(-1, 128)[largest],
    )


class FeatureStore:
    """Features by shot index: extracted on first demand, kept on disk, the last ones in memory; thread-safe."""

    def __init__(self, folder: Path, max_features: int, threads: int = 0) -> None:
        """`threads` of the processor, 0 for all."""
        self._folder = folder
        self._max_features = max_features
        self._threads = threads or os.cpu_count() or 1
        self._recent: OrderedDict[int, Features] = OrderedDict()
        self._lock = threading.Lock()

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
        with ArrayFile(path) as stored:
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
