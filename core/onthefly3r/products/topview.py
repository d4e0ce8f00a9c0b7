"""The cloud seen from above: the topmost point of each pixel, accumulated in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..geometry.arrays import Bool, Float, UInt8

CHUNK_POINTS = 1_000_000
FILL_STEPS = 2  # empty pixels this far from a filled one are filled


@dataclass(frozen=True)
class Window:
    """A map window in the plane of the export frame, m; x to the right, y up."""

    min_x: float
    min_y: float
    max_x: float
    max_y: float

    @property
    def width(self) -> float:
        """Extent along x, m."""
        return self.max_x - self.min_x

    @property
    def height(self) -> float:
        """Extent along y, m."""
        return self.max_y - self.min_y

    def grown(self, margin: float) -> Window:
        """Return the window with a margin on all sides, m."""
        return Window(self.min_x - margin, self.min_y - margin, self.max_x + margin, self.max_y + margin)


@dataclass
class TopView:
    """Pixels of a window from above; row 0 is the upper edge."""

    window: Window
    pixel_m: float
    rgb: UInt8 = field(init=False)  # (H, W, 3)
    top: Float = field(init=False)  # (H, W) height of the topmost point, m; -inf where there is none

    def __post_init__(self) -> None:
        width = max(1, int(np.ceil(self.window.width / self.pixel_m)))
        height = max(1, int(np.ceil(self.window.height / self.pixel_m)))
        self.rgb = np.zeros((height, width, 3), np.uint8)
        self.top = np.full((height, width), -np.inf)

    def to_pixels(self, xy: Float) -> Float:
        """Return pixel coordinates (..., 2) of map positions (..., 2), origin at the top-left corner."""
        xy = np.asarray(xy, float)
        return np.stack(
            [(xy[..., 0] - self.window.min_x) / self.pixel_m, (self.window.max_y - xy[..., 1]) / self.pixel_m], axis=-1
        )

    def add(self, points: Float, rgb: UInt8) -> None:
        """Draw points (N, 3) with their colours (N, 3); those outside the window are left out."""
        height, width = self.top.shape
        column, row = np.floor(self.to_pixels(points[:, :2])).astype(np.int64).T
        inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
        pixel = row[inside] * width + column[inside]
        z = points[inside, 2]
        higher = np.flatnonzero(z > self.top.ravel()[pixel])
        # Ascending, because of several writes to one pixel the last one stays.
        order = higher[np.argsort(z[higher], kind="stable")]
        self.top.reshape(-1)[pixel[order]] = z[order]
        self.rgb.reshape(-1, 3)[pixel[order]] = rgb[inside[order]]

    @property
    def filled(self) -> Bool:
        """Pixels (H, W) that hold a point."""
        return np.asarray(np.isfinite(self.top))

    def close_gaps(self) -> None:
        """Give empty pixels the mean colour and height of the filled ones around them, a few pixels far."""
        from scipy.ndimage import uniform_filter

        for _ in range(FILL_STEPS):
            known = self.filled
            share = uniform_filter(known.astype(np.float32), 3)
            fill = ~known & (share > 0.3)  # at least three of nine: outlines do not grow
            for band in range(3):
                total = uniform_filter(np.where(known, self.rgb[..., band], 0).astype(np.float32), 3)
                self.rgb[..., band][fill] = np.rint(total[fill] / share[fill]).astype(np.uint8)
            total = uniform_filter(np.where(known, self.top, 0.0), 3)
            self.top[fill] = total[fill] / share[fill]


def read_points(path: Path) -> Iterator[tuple[Float, UInt8]]:
    """Yield points (N, 3) and 8-bit colours (N, 3) of one of our LAS or LAZ files in chunks."""
    import laspy

    with laspy.open(path) as reader:
        for chunk in reader.chunk_iterator(CHUNK_POINTS):
            rgb = np.stack([np.asarray(band) >> 8 for band in (chunk.red, chunk.green, chunk.blue)], axis=1)
            yield np.stack([np.asarray(axis) for axis in (chunk.x, chunk.y, chunk.z)], axis=1), rgb.astype(np.uint8)
