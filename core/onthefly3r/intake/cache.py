"""Working images by shot index: each photograph is decoded once, the last ones stay in memory, the others on disk."""

from __future__ import annotations

import tempfile
import threading
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from ..records import Shot, WorkingImage

CACHED_IMAGES = 64  # about 2.3 MB each at 1000 x 750


class ImageCache(Mapping[int, WorkingImage]):
    """A read-only mapping of shot index to working image; thread-safe.

    Images that memory has no room for lie in `folder`, as they are: to compress them takes longer than to decode the
    photograph again. Without a folder they are decoded again. Files that are there already are not looked at.
    """

    def __init__(
        self, shots: Mapping[int, Shot], load: Callable[[Shot], WorkingImage], folder: Path | None = None
    ) -> None:
        self._shots = shots
        self._load = load
        self._folder = folder
        self._recent: OrderedDict[int, WorkingImage] = OrderedDict()
        self._stored: dict[int, tuple[WorkingImage, tuple[int, ...]]] = {}  # without pixels, and their shape
        self._lock = threading.Lock()
        self._loading: defaultdict[int, threading.Lock] = defaultdict(threading.Lock)

    def __getitem__(self, index: int) -> WorkingImage:
        """Return one image; raises `PhotographError` when its pixels are damaged."""
        with self._lock:
            if index in self._recent:
                self._recent.move_to_end(index)
                return self._recent[index]
            loading = self._loading[index]
        with loading:  # who asks for the same image meanwhile waits for it
            with self._lock:
                known, stored = self._recent.get(index), self._stored.get(index)
            if known is not None:
                return known
            image = (self._read(index, *stored) if stored else None) or self._load(self._shots[index])
            self._remember(index, image)
        return image

    def __iter__(self) -> Iterator[int]:
        return iter(self._shots)

    def __len__(self) -> int:
        return len(self._shots)

    def _remember(self, index: int, image: WorkingImage) -> None:
        with self._lock:
            self._recent[index] = image
            over = max(0, len(self._recent) - CACHED_IMAGES)
            leaving = list(islice(self._recent.items(), over))
        for number, old in leaving:  # each is at hand until it is on the disk, so that nobody decodes it again
            if self._folder is not None and number not in self._stored:
                self._write(number, old, self._folder)
        with self._lock:
            for number, _ in leaving:
                self._recent.pop(number, None)

    def _write(self, index: int, image: WorkingImage, folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path = _path(folder, index)
            with tempfile.NamedTemporaryFile(dir=folder, prefix=path.stem, delete=False) as part:
                part.write(image.rgb.tobytes())
            Path(part.name).replace(path)  # whole at once: another thread may be reading it
        except OSError:  # no room: the photograph is decoded again when it is asked for
            return
        with self._lock:
            self._stored[index] = replace(image, rgb=image.rgb[:0]), image.rgb.shape

    def _read(self, index: int, stored: WorkingImage, shape: tuple[int, ...]) -> WorkingImage | None:
        """Return the image from disk; None where it is not there any more."""
        assert self._folder is not None
        try:
            pixels = np.fromfile(_path(self._folder, index), np.uint8)
        except OSError:
            return None
        return replace(stored, rgb=pixels.reshape(shape)) if pixels.size == np.prod(shape) else None


def _path(folder: Path, index: int) -> Path:
    return folder / f"{index:06d}.rgb"
