"""How sharp and how well exposed a photograph is, measured on its pixels at working size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float, UInt8

BLACK, WHITE = 8, 247  # brightness at or beyond which no detail is left


@dataclass(frozen=True)
class Quality:
    """Figures of one photograph; what counts as too little depends on the others of its flight."""

    sharpness: float  # about 1 for a sharp photograph, falls with blur in any direction, whatever the contrast
    dark: float  # share of pixels that are black
    bright: float  # share of pixels that are white
    contrast: float  # standard deviation of the brightness, 0..128


def measure_quality(rgb: UInt8) -> Quality:
    """Measure an upright image (H, W, 3)."""
    grey = rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    directions = (grey, grey.T, _sheared(grey, 1), _sheared(grey, -1))
    return Quality(
        sharpness=min(_steepness(lines) for lines in directions),
        dark=float(np.mean(grey <= BLACK)),
        bright=float(np.mean(grey >= WHITE)),
        contrast=float(grey.std()),
    )


def _steepness(grey: Float) -> float:
    """Return how fast brightness changes along the columns: second differences over first ones (both RMS)."""
    slope = np.diff(grey, axis=0)
    bend = np.diff(slope, axis=0)
    energy = float(np.mean(np.square(slope)))
    return float(np.sqrt(np.mean(np.square(bend)) / energy)) if energy > 0.0 else 0.0


def _sheared(grey: Float, step: int) -> Float:
    """Return lines along a diagonal as columns: every row is shifted by one more pixel than the row above."""
    height, width = grey.shape
    rows = np.arange(height)[:, None]
    columns = (np.arange(width)[None, :] + step * rows) % width
    return np.asarray(grey[rows, columns])
