"""Rejected images, kept until the map has grown around them and tried once more at the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .index import RetrievalIndex

ENOUGH_NEW_NEIGHBOURS = 2  # frames placed since that would be among the image's references


@dataclass
class _Aside:
    """An image that was rejected."""

    threshold: float  # similarity of its last reference: a new frame above it would replace that one
    new_neighbours: int = 0


class RetryQueue:
    """Decides when a rejected image is worth another try.

    `attempts` counts the rejections of each image, `retries` how often it was tried again.
    """

    def __init__(self, max_retries: int) -> None:
        self.attempts: dict[int, int] = {}
        self.retries: dict[int, int] = {}
        self._max_retries = max_retries
        self._aside: dict[int, _Aside] = {}

    def __len__(self) -> int:
        return len(self._aside)

    @property
    def aside(self) -> list[int]:
        """The images that wait here."""
        return list(self._aside)

    @property
    def memory(self) -> tuple[dict[int, int], dict[int, int], list[tuple[int, float, int]]]:
        """Rejections and retries of images, and those that wait here in order, each with what decides on it."""
        aside = [(index, one.threshold, one.new_neighbours) for index, one in self._aside.items()]
        return self.attempts, self.retries, aside

    @memory.setter
    def memory(self, known: tuple[dict[int, int], dict[int, int], list[tuple[int, float, int]]]) -> None:
        self.attempts, self.retries, aside = known
        self._aside = {index: _Aside(threshold, new) for index, threshold, new in aside}

    def reopen(self) -> None:
        """Make every image worth another try: two fragments became one."""
        for aside in self._aside.values():
            aside.new_neighbours = max(aside.new_neighbours, ENOUGH_NEW_NEIGHBOURS)

    def set_aside(self, index: int, retrieval: RetrievalIndex, references: int) -> None:
        """Keep a rejected image that would take so many references."""
        best = retrieval.top([index], references)[index]
        threshold = best[-1].similarity if len(best) == references else -1.0
        self.attempts[index] = self.attempts.get(index, 0) + 1
        self._aside[index] = _Aside(threshold)

    def placed(self, new: Sequence[int], retrieval: RetrievalIndex) -> None:
        """Note that the map has grown by new frames, which may be neighbours of what waits here."""
        for index in new:
            self._aside.pop(index, None)
        if not self._aside or not new:
            return
        similarity = retrieval.similarities(list(self._aside), new)
        for aside, row in zip(self._aside.values(), similarity, strict=True):
            aside.new_neighbours += int((row > aside.threshold).sum())

    def take_ready(self, finishing: bool) -> list[int]:
        """Return and forget the images to try now, those with fewer rejections first.

        While images arrive, an image is tried again when its neighbourhood has grown. At the end every one is tried
        as often as allowed, and beyond that as long as its neighbourhood still grows.
        """
        if self._max_retries == 0:
            return []

        def is_ready(index: int, aside: _Aside) -> bool:
            allowed = self.attempts[index] <= self._max_retries
            if finishing:
                return allowed or aside.new_neighbours > 0
            return allowed and aside.new_neighbours >= ENOUGH_NEW_NEIGHBOURS

        ready = [index for index, aside in self._aside.items() if is_ready(index, aside)]
        for index in ready:
            del self._aside[index]
            self.retries[index] = self.retries.get(index, 0) + 1
        return sorted(ready, key=lambda i: (self.attempts[i], i))
