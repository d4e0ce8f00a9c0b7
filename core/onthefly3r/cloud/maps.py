"""Depth maps and pictures of all photographs on disk, with a bounded number of them in memory."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any

import numpy as np

CACHE_BYTES = 256 * 2**20


class MapFolder:
    """Arrays by kind and shot index in a folder of our own, which is emptied on leaving the context."""

    def __init__(self, folder: Path, cache_bytes: int = CACHE_BYTES) -> None:
        self._folder, self._limit = folder, cache_bytes
        self._recent: OrderedDict[tuple[str, int], np.ndarray[Any, Any]] = OrderedDict()
        self._held = 0
        self._lock = Lock()

    def __enter__(self) -> MapFolder:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._clear()  # of a run that was killed
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clear()

    def write(self, kind: str, index: int, values: np.ndarray[Any, Any]) -> None:
        """Keep an array."""
        np.save(self._path(kind, index), values, allow_pickle=False)
        with self._lock:
            self._remember((kind, index), values)

    def read(self, kind: str, index: int) -> np.ndarray[Any, Any]:
        """Return an array that was written; it must not be changed."""
        with self._lock:
            found = self._recent.get((kind, index))
            if found is not None:
                self._recent.move_to_end((kind, index))
                return found
        values: np.ndarray[Any, Any] = np.load(self._path(kind, index), allow_pickle=False)
        with self._lock:
            self._remember((kind, index), values)
        return values

    def forget(self, kind: str) -> None:
        """Remove all arrays of a kind."""
        with self._lock:
            for key in [key for key in self._recent if key[0] == kind]:
                self._held -= self._recent.pop(key).nbytes
        for path in self._folder.glob(f"map-{kind}-*.npy"):
            path.unlink()

    def _remember(self, key: tuple[str, int], values: np.ndarray[Any, Any]) -> None:
        replaced = self._recent.pop(key, None)
        self._held += values.nbytes - (replaced.nbytes if replaced is not None else 0)
        self._recent[key] = values
        while self._held > self._limit and len(self._recent) > 1:
            self._held -= self._recent.popitem(last=False)[1].nbytes

    def _path(self, kind: str, index: int) -> Path:
        return self._folder / f"map-{kind}-{index:06d}.npy"

    def _clear(self) -> None:
        for path in self._folder.glob("map-*.npy"):
            path.unlink()
