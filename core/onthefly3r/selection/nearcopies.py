"""Photographs that are nearly the same picture: between them there is no parallax, and no depth to be had.

A drone that hovers, or a shutter that fires twice, gives bursts which any retrieval finds most alike. Small pictures
tell them: they correlate, and the best shift between them is a small part of the image. Of a baseline that moves the
ground by a share s of the longest side, rays meet at an angle of about s over the focal ratio.
"""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import Float, UInt8

SIDE_PX = 64
SAME_CORRELATION = 0.8  # of the small pictures once shifted onto each other
LEAST_SHIFT = 0.02  # of the longest side: rays that meet at less than 2 degrees


class NearCopies:
    """Small grey pictures by shot index."""

    def __init__(self) -> None:
        self._small: dict[int, UInt8] = {}

    def add(self, index: int, rgb: UInt8) -> None:
        """Keep a small picture of an upright image (H, W, 3)."""
        self.keep(index, small_picture(rgb))

    def keep(self, index: int, small: UInt8) -> None:
        """Keep what `small_picture` made of an image."""
        self._small[index] = small

    def __call__(self, first: int, second: int) -> bool:
        """Return whether two images are nearly the same picture; False where one is not known."""
        kept, other = self._small.get(first), self._small.get(second)
        if kept is None or other is None or kept.shape != other.shape:
            return False
        import cv2

        a, b = (_centred(small) for small in (kept, other))

        reach = max(1, round(LEAST_SHIFT * SIDE_PX))
        inner = b[reach:-reach, reach:-reach]
        if float(inner.std()) < 1e-3 or float(a.std()) < 1e-3:
            return False
        wide = 4 * reach
        padded = np.asarray(cv2.copyMakeBorder(a, wide, wide, wide, wide, cv2.BORDER_CONSTANT, value=0.0))
        found = cv2.matchTemplate(padded, inner.astype(np.float32), cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(found)), found.shape)
        shift = max(abs(int(row) - wide - reach), abs(int(column) - wide - reach))
        return shift <= reach and float(found[row, column]) >= SAME_CORRELATION


def small_picture(rgb: UInt8) -> UInt8:
    """Return a small grey picture of an upright image (H, W, 3)."""
    import cv2

    height, width = rgb.shape[:2]
    scale = SIDE_PX / max(height, width)
    size = max(8, round(width * scale)), max(8, round(height * scale))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).mean(axis=2).astype(np.uint8))


def _centred(small: UInt8) -> Float:
    grey = small.astype(np.float32)
    return np.asarray(grey - grey.mean())
