"""Working images by shot index, decoded on demand; only the last ones stay in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping

from ..records import Shot, WorkingImage

CACHED_IMAGES = 64  # about 2.3 MB each at 1000 x 750


class ImageCache(Mapping[int, WorkingImage]):
    """A read-only mapping of shot index to working image; thread-safe."""

    def __init__(self, shots: Mapping[int, Shot], load: Callable[[Shot], WorkingImage]) -> None:
        self._shots = shots
        self._load = load
        self._recent: OrderedDict[int, WorkingImage] = OrderedDict()
        self._lock = threading.Lock()

    def __getitem__(self, index: int) -> WorkingImage:
        """Return one image; raises `PhotographError` when its pixels are damaged."""
        with self._lock:
            if index in self._recent:
                self._recent.move_to_end(index)
                return self._recent[index]
        image = self._load(self._shots[index])
        with self._lock:
            self._recent[index] = image
            while len(self._recent) > CACHED_IMAGES:
                self._recent.popitem(last=False)
        return image

    def __iter__(self) -> Iterator[int]:
        return iter(self._shots)

    def __len__(self) -> int:
        return len(self._shots)
