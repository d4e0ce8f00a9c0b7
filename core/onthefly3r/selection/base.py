"""The contract of a retrieval descriptor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from ..geometry.arrays import Float
from ..records import WorkingImage


class Describer(Protocol):
    """Turns images into L2-normalised vectors whose dot product is a similarity (Eq. 4)."""

    def fit(self, images: Mapping[int, WorkingImage]) -> None:
        """Learn what must be learnt (a codebook) from the first images, by shot index; called once."""
        ...

    def describe(self, index: int, image: WorkingImage) -> Float:
        """Return the descriptor (D,) float32 of one image."""
        ...
