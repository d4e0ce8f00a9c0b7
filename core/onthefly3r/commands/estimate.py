"""How long a run takes and how much memory it needs on this machine, within a factor of two."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

from ..features.extraction import extract_features
from ..intake.images import load_working_image
from ..options import Options
from ..records import Shot

TIMED_PHOTOGRAPHS = 3
# One photograph takes about so many times as long as finding its features; the dense part follows the share of its
# pixels. Measured on surveys of 12 to 172 photographs.
SPARSE_FACTOR, DENSE_FACTOR = 6.0, 25.0
BASE_MIB, IMAGE_MIB, MOST_IMAGES_MIB = 350.0, 9.0, 700.0  # at 1000 px; only the last images stay in memory


def estimated_time_s(shots: Sequence[Shot], options: Options) -> float | None:
    """Time a few photographs on this machine and extrapolate; None for neural backbones, which nothing here times."""
    if not shots or options.backbone.backbone != "classical":
        return None
    sample = shots[:: max(1, len(shots) // TIMED_PHOTOGRAPHS)][:TIMED_PHOTOGRAPHS]
    threads = options.backbone.threads or os.cpu_count() or 1
    began = time.perf_counter()
    images = [load_working_image(shot, options.backbone.working_px).rgb for shot in sample]
    extract_features(images, options.backbone.features, threads=1)
    features_s = (time.perf_counter() - began) / len(sample) / threads
    dense = min(1.0, options.backbone.dense_px / options.backbone.working_px) ** 2
    return len(shots) * features_s * (1.0 + SPARSE_FACTOR + DENSE_FACTOR * dense)


def estimated_memory_mib(count: int, options: Options) -> float:
    """Return the most memory that a run over so many photographs holds."""
    size = (options.backbone.working_px / 1000.0) ** 2
    return BASE_MIB + size * min(MOST_IMAGES_MIB, IMAGE_MIB * count)
