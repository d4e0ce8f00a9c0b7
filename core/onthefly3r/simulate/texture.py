"""World-anchored procedural texture: the same place has the same colour from wherever it is seen.

Colours are functions of two coordinates in metres on the surface's own texture plane. Details finer than the
footprint of a pixel are left out, as the optics of a camera would blur them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..geometry.arrays import Float

LATTICE = 512  # random values per side of the noise tile
TILE_PX_PER_CELL = 4
ROW_LENGTH = 2048
FINEST_CELL_M = 0.12
DETAIL_OCTAVES = 8
ROAD_SPACING_M = 130.0
ROAD_HALF_WIDTH_M = 3.0

GRASS, MEADOW, SOIL, ASPHALT = (
    np.array(c, np.float32) for c in [(96, 116, 66), (146, 142, 86), (150, 120, 92), (112, 112, 116)]
)


@lru_cache(maxsize=4)
def _noise_tile(seed: int) -> Float:
    """Return a periodic tile of smooth noise with zero mean and unit variance, float32."""
    import cv2

    lattice = np.random.default_rng(seed).standard_normal((LATTICE, LATTICE)).astype(np.float32)
    border = 4
    padded = np.pad(lattice, border, mode="wrap")
    size = padded.shape[0] * TILE_PX_PER_CELL
    smooth = cv2.resize(padded, (size, size), interpolation=cv2.INTER_CUBIC)
    cut = border * TILE_PX_PER_CELL
    tile = smooth[cut:-cut, cut:-cut]
    return np.ascontiguousarray((tile - tile.mean()) / tile.std())


@dataclass(frozen=True)
class Texture:
    """Colours of ground, roofs and walls, drawn from a seed."""

    seed: int

    def noise(self, a: Float, b: Float, cell_m: float, channel: int = 0) -> Float:
        """Return unit-variance noise (N,) whose features have the size `cell_m`; a, b: (N,) float32 metres.

        Every cell size and channel turns and shifts the tile its own way, so that sums do not repeat.
        """
        import cv2

        rng = np.random.default_rng((self.seed, channel, round(cell_m * 1000)))
        angle = rng.uniform(0.0, 2.0 * np.pi)
        shift_u, shift_v = rng.uniform(0.0, LATTICE * TILE_PX_PER_CELL, 2)
        size = float(LATTICE * TILE_PX_PER_CELL)
        c, s = np.cos(angle) * TILE_PX_PER_CELL / cell_m, np.sin(angle) * TILE_PX_PER_CELL / cell_m
        u = np.float32(c) * a - np.float32(s) * b + np.float32(shift_u)
        v = np.float32(s) * a + np.float32(c) * b + np.float32(shift_v)
        u -= np.float32(size) * np.floor(u / np.float32(size))
        v -= np.float32(size) * np.floor(v / np.float32(size))
        # OpenCV samples images: fold the list into rows.
        u, v = (np.pad(w, (0, -len(w) % ROW_LENGTH)).reshape(-1, ROW_LENGTH) for w in (u, v))
        tile = _noise_tile(self.seed)
        values = cv2.remap(tile, u, v, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(values).ravel()[: len(a)]

    def detail(self, a: Float, b: Float, footprint_m: float) -> Float:
        """Return the relative brightness variation (N,), octaves from 0.12 m up; two of them have sharp edges."""
        total = np.zeros_like(a)
        for octave in range(DETAIL_OCTAVES):
            cell_m = FINEST_CELL_M * 2.0**octave
            visible = np.float32(min(1.0, 2.0 * cell_m / max(footprint_m, 1e-6) - 2.0))
            if visible <= 0.0:
                continue
            value = visible * self.noise(a, b, cell_m)
            if octave in (2, 4, 5):  # pebbles, tufts and bushes: dark and light blobs with an outline
                total += 0.13 * (np.clip(4.0 * value - 4.0, 0.0, 1.0) - np.clip(-4.0 * value - 4.0, 0.0, 1.0))
            total += np.float32(0.055) * value
        return total

    def ground(self, a: Float, b: Float, detail: Float) -> Float:
        """Return colours (N, 3) float32 of fields, bare soil and roads."""
        patches = self.noise(a, b, 40.0, 1) + 0.5 * self.noise(a, b, 11.0, 2) + 2.0 * detail
        meadow = np.clip(3.0 * patches + 0.5, 0.0, 1.0)[:, None]
        soil = np.clip(5.0 * patches - 5.0, 0.0, 1.0)[:, None]
        colour = GRASS + (MEADOW - GRASS) * meadow
        colour += (SOIL - colour) * soil
        for along, across in ((a, b), (b, a)):
            distance = self.distance_to_road(along, across)
            near = np.flatnonzero(distance < ROAD_HALF_WIDTH_M + 0.5)
            distance, way = distance[near, None], along[near, None]
            road = np.clip((ROAD_HALF_WIDTH_M - distance) / 0.15 + 0.5, 0.0, 1.0)
            dash = np.clip((0.12 - distance) / 0.1 + 0.5, 0.0, 1.0) * (np.mod(way, 7.0) < 3.5)
            colour[near] += (ASPHALT - colour[near]) * road + np.float32(120.0) * dash
        colour *= 1.0 + detail[:, None]
        return np.asarray(colour)

    @staticmethod
    def distance_to_road(along: Float, across: Float) -> Float:
        """Return the distance in metres to the nearest road that runs along the first coordinate."""
        centre = across - 6.0 * np.sin(along / np.float32(37.0)) - np.float32(0.5 * ROAD_SPACING_M)
        return np.asarray(np.abs(centre - ROAD_SPACING_M * np.round(centre / ROAD_SPACING_M)))

    def roof(self, a: Float, b: Float, base: Float, detail: Float) -> Float:
        """Return colours (N, 3) of roofs: rows of tiles, stains, skylights; `base` (N, 3)."""
        rows = 0.05 * np.sign(np.mod(b, 0.8) - 0.4)
        stains = 0.10 * self.noise(a, b, 2.3, 3)
        return np.asarray(self._panels(a, b, 1.3, base * (1.0 + 1.3 * detail + rows + stains)[..., None], 0.86))

    def wall(self, a: Float, b: Float, base: Float, detail: Float) -> Float:
        """Return colours (N, 3) of walls with irregular dark openings; `base` (N, 3)."""
        return np.asarray(self._panels(a, b, 1.1, base * (1.0 + detail)[..., None], 0.7))

    def _panels(self, a: Float, b: Float, size_m: float, colour: Float, share: float) -> Float:
        """Paint rectangles of random brightness into the cells of a grid that draw more than `share`."""
        column, row = np.floor(a / np.float32(size_m)), np.floor(b / np.float32(size_m))
        draw = np.mod(np.sin(column * np.float32(12.9898) + row * np.float32(78.233)) * np.float32(437.585), 1.0)
        inside = (np.abs(np.mod(a, size_m) - size_m / 2) < 0.36 * size_m) & (
            np.abs(np.mod(b, size_m) - size_m / 2) < 0.3 * size_m
        )
        tone = (40.0 + 190.0 * np.mod(draw * np.float32(97.0), 1.0))[..., None]
        return np.where((inside & (draw > share))[..., None], np.asarray(tone, np.float32), colour)
