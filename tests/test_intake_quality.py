"""Sharpness and exposure measured on pixels."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.geometry.arrays import UInt8
from onthefly3r.intake.quality import measure_quality


def textured(seed: int = 3, contrast: float = 40.0) -> UInt8:
    """An image with detail of all sizes, like ground seen from above."""
    rng = np.random.default_rng(seed)
    grey = np.zeros((240, 320))
    for cell in (1, 2, 4, 8, 16, 40):
        coarse = rng.normal(size=(240 // cell + 1, 320 // cell + 1))
        grey += np.kron(coarse, np.ones((cell, cell)))[:240, :320] * np.sqrt(cell)
    grey = 120.0 + contrast * grey / grey.std()
    return np.clip(np.repeat(grey[:, :, None], 3, axis=2), 0, 255).astype(np.uint8)


def smeared(rgb: UInt8, steps: list[tuple[int, int]]) -> UInt8:
    """The mean of shifted copies: the motion of a camera while the shutter is open."""
    copies = [np.roll(rgb.astype(float), step, axis=(0, 1)) for step in steps]
    return np.mean(copies, axis=0).astype(np.uint8)


@pytest.mark.parametrize("direction", [(0, 1), (1, 0), (1, 1), (1, -1)])
def test_motion_in_any_direction_costs_sharpness(direction: tuple[int, int]) -> None:
    sharp = textured()
    blurred = smeared(sharp, [(direction[0] * k, direction[1] * k) for k in range(6)])
    assert measure_quality(blurred).sharpness < 0.72 * measure_quality(sharp).sharpness


def test_sharpness_does_not_depend_on_contrast_or_subject() -> None:
    reference = measure_quality(textured()).sharpness
    assert measure_quality(textured(contrast=12.0)).sharpness == pytest.approx(reference, rel=0.1)
    assert measure_quality(textured(seed=8)).sharpness == pytest.approx(reference, rel=0.05)


def test_exposure() -> None:
    rgb = textured()
    rgb[:60] = 0
    rgb[60:180] = 255
    quality = measure_quality(rgb)
    assert quality.dark == pytest.approx(0.25, abs=0.02)
    assert quality.bright == pytest.approx(0.5, abs=0.02)


def test_uniform_image_has_neither_contrast_nor_sharpness() -> None:
    quality = measure_quality(np.full((50, 60, 3), 90, np.uint8))
    assert (quality.sharpness, quality.contrast, quality.dark, quality.bright) == (0.0, 0.0, 0.0, 0.0)
