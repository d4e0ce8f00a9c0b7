"""The pinhole camera with OpenCV distortion, and pixel maps between image sizes.

Pixel coordinates have their origin at the top-left corner of the image, as in COLMAP: the centre of the
pixel in row v, column u is (u + 0.5, v + 0.5). Camera axes are OpenCV's: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .arrays import Float


@dataclass(frozen=True)
class PixelMap:
    """Axis-aligned affine map between pixel coordinates of two images: target = scale * source + offset."""

    scale_x: float = 1.0
    scale_y: float = 1.0
    offset_x: float = 0.0
    offset_y: float = 0.0

    def apply(self, pixels: Float) -> Float:
        """Map pixel coordinates (..., 2)."""
        return np.asarray(pixels) * (self.scale_x, self.scale_y) + (self.offset_x, self.offset_y)

    def inverse(self) -> PixelMap:
        """Return the map from the target image back to the source image."""
        return PixelMap(
            1.0 / self.scale_x, 1.0 / self.scale_y, -self.offset_x / self.scale_x, -self.offset_y / self.scale_y
        )


@dataclass(frozen=True)
class Camera:
    """Intrinsics for one image size; distortion follows OpenCV (k1, k2, p1, p2), COLMAP model OPENCV."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def matrix(self) -> Float:
        """Return K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def through(self, pixel_map: PixelMap, width: int, height: int) -> Camera:
        """Return the same camera for the image that `pixel_map` leads to."""
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * pixel_map.scale_x,
            fy=self.fy * pixel_map.scale_y,
            cx=self.cx * pixel_map.scale_x + pixel_map.offset_x,
            cy=self.cy * pixel_map.scale_y + pixel_map.offset_y,
        )

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera for the whole image scaled to another size."""
        return self.through(PixelMap(width / self.width, height / self.height), width, height)

    def project(self, points: Float) -> Float:
        """Project points (..., 3) in the camera frame to pixels (..., 2); points behind give NaN."""
        points = np.asarray(points, float)
        z = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
        x, y = points[..., 0] / z, points[..., 1] / z
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial = r2 * (k1 + k2 * r2)
        xd = x + x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y + y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
        return np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)

    def rays(self, pixels: Float) -> Float:
        """Return directions (..., 3) with z = 1 in the camera frame through pixels (..., 2)."""
        pixels = np.asarray(pixels, float)
        xd, yd = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        k1, k2, p1, p2 = self.distortion
        x, y = xd, yd
        if any(self.distortion):
            for _ in range(20):  # fixed point, as OpenCV; drone lenses converge in a few steps
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + k2 * r2)
                dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
                dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
                x, y = (xd - dx) / radial, (yd - dy) / radial
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def pixel_centres(self) -> Float:
        """Return the pixel coordinates (H, W, 2) of all pixel centres."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([u, v], axis=-1)
