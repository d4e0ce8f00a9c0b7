"""Where time and memory go: seconds add up by stage, memory is noted for the stage that raised it."""

from __future__ import annotations

import sys
import time
import types

import numpy as np
import pytest

from onthefly3r.stopwatch import Stopwatch, peak_rss_mib


def test_seconds_add_up_by_stage_even_when_it_fails() -> None:
    watch = Stopwatch()
    with watch.stage("a"):
        time.sleep(0.02)
    with pytest.raises(ValueError, match="no"), watch.stage("a"):
        time.sleep(0.02)
        raise ValueError("no")
    with watch.stage("b"):
        pass
    assert 0.04 <= watch.stages["a"] <= watch.total_s
    assert watch.stages["b"] < 0.02


def test_peak_memory_grows_with_what_is_allocated() -> None:
    before = peak_rss_mib()
    if before is None:
        pytest.skip("this system does not tell")
    block = np.ones(int(before * 2**20 / 8) + 2**23)  # more than the peak so far
    after = peak_rss_mib()
    assert after is not None
    assert after >= before + 0.9 * 2**23 * 8 / 2**20
    assert block[0] == 1.0


def test_memory_is_noted_for_the_stage_that_raised_it() -> None:
    before = peak_rss_mib()
    if before is None:
        pytest.skip("this system does not tell")
    watch = Stopwatch()
    with watch.stage("frugal"):
        pass
    with watch.stage("greedy"):
        np.ones(int(before * 2**20 / 8) + 2**23)  # more than the peak so far
    with watch.stage("frugal"):
        pass
    assert set(watch.memory) == {"greedy"}
    assert watch.memory["greedy"]["peak_rss_mib"] >= before + 0.9 * 2**23 * 8 / 2**20


class FakeCuda:
    """Memory of a GPU as torch.cuda counts it."""

    def __init__(self) -> None:
        self.now = self.peak = 100 * 2**20

    def is_initialized(self) -> bool:
        return True

    def reset_peak_memory_stats(self) -> None:
        self.peak = self.now

    def max_memory_allocated(self) -> int:
        return self.peak


def test_gpu_memory_is_the_most_within_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = FakeCuda()
    monkeypatch.setitem(sys.modules, "torch", types.SimpleNamespace(cuda=cuda))
    watch = Stopwatch()
    for most in (900, 700):
        with watch.stage("backbone"):
            cuda.peak = most * 2**20
    with watch.stage("map"):
        pass
    assert watch.memory["backbone"]["peak_gpu_mib"] == 900.0
    assert watch.memory["map"]["peak_gpu_mib"] == 100.0  # what the network itself holds all the time
