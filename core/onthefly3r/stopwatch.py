"""Where the time and the memory of a run go."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MIB = 1024.0**2


class Stopwatch:
    """Wall-clock seconds and peak memory by stage; stages do not nest."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._peak_rss_mib = peak_rss_mib() or 0.0
        self.stages: dict[str, float] = {}  # s
        self.memory: dict[str, dict[str, float]] = {}  # stage -> peak_rss_mib, peak_gpu_mib

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage, and note the memory that it took.

        `peak_rss_mib` is the most that the process had ever had resident when the stage last raised that figure: a
        stage that never did lacks it. `peak_gpu_mib` is the most that torch had allocated on the GPU meanwhile.
        """
        start = time.perf_counter()
        cuda = _cuda()
        if cuda is not None:
            cuda.reset_peak_memory_stats()
        try:
            yield
        finally:
            self.stages[name] = self.stages.get(name, 0.0) + time.perf_counter() - start
            self._note_memory(name)

    @property
    def total_s(self) -> float:
        """Seconds since the stopwatch was made."""
        return time.perf_counter() - self._start

    def _note_memory(self, name: str) -> None:
        peak, cuda = peak_rss_mib(), _cuda()
        if peak is not None and peak > self._peak_rss_mib:
            self._peak_rss_mib = peak
            self.memory.setdefault(name, {})["peak_rss_mib"] = peak
        on_gpu = cuda.max_memory_allocated() / MIB if cuda is not None else 0.0
        if on_gpu > 0.0:
            known = self.memory.setdefault(name, {})
            known["peak_gpu_mib"] = max(on_gpu, known.get("peak_gpu_mib", 0.0))


def peak_rss_mib() -> float | None:
    """Return the most memory this process has had resident, MiB; None where the system does not tell."""
    if sys.platform == "win32":
        return _peak_working_set_mib()
    if sys.platform == "linux":
        # What getrusage tells includes what the parent had resident when it started this process.
        with contextlib.suppress(OSError, StopIteration):
            lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
            return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (MIB if sys.platform == "darwin" else 1024.0)  # bytes on macOS, KiB elsewhere


def _peak_working_set_mib() -> float | None:
    import ctypes
    from ctypes import wintypes

    class Counters(ctypes.Structure):  # PROCESS_MEMORY_COUNTERS of psapi.h
        _fields_ = (
            ("cb", wintypes.DWORD),
            ("PageFaultCount", wintypes.DWORD),
            *((name, ctypes.c_size_t) for name in ("PeakWorkingSetSize", "WorkingSetSize")),
            *((f"Quota{i}", ctypes.c_size_t) for i in range(4)),
            *((name, ctypes.c_size_t) for name in ("PagefileUsage", "PeakPagefileUsage")),
        )

    counters = Counters(cb=ctypes.sizeof(Counters))
    kernel = ctypes.WinDLL("kernel32")  # type: ignore[attr-defined,unused-ignore]
    kernel.GetCurrentProcess.restype = wintypes.HANDLE
    query = kernel.K32GetProcessMemoryInfo
    query.argtypes = (wintypes.HANDLE, ctypes.POINTER(Counters), wintypes.DWORD)
    if not query(kernel.GetCurrentProcess(), ctypes.byref(counters), counters.cb):
        return None
    return float(counters.PeakWorkingSetSize) / MIB


def _cuda() -> Any:
    """Return torch's module of an NVIDIA GPU that is in use; None where torch was not needed so far."""
    torch = sys.modules.get("torch")
    return torch.cuda if torch is not None and torch.cuda.is_initialized() else None
