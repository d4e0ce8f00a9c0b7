"""Whether a file is still the one that was looked at, and patience with files that cannot be read for a moment."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Stamp = tuple[int, int]  # size in bytes, time of the last change in ns
Found = TypeVar("Found")

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 1.6  # the waits double: about 3 s for one file
_PASSING = {  # errors that may be gone a moment later
    getattr(errno, name)
    for name in ("ENOENT", "EACCES", "EPERM", "EBUSY", "EIO", "ESTALE", "EAGAIN", "ETIMEDOUT", "ENODEV", "EHOSTDOWN")
    if hasattr(errno, name)
}
SETTLED_S = 0.3  # a file that is being copied changes more often than this


class Patience:
    """How long a run waits, all files together, for what may come back: a copy in progress, a drive that sleeps."""

    def __init__(self, budget_s: float = 30.0, sleep: Callable[[float], None] = time.sleep) -> None:
        self._budget_s = self._left_s = budget_s
        self._sleep = sleep
        self._lock = threading.Lock()

    def attempt(self, read: Callable[[], Found]) -> tuple[Found, bool]:
        """Return what `read` returns, and whether it took more than one try; raises its last `OSError`."""
        wait_s, waited = FIRST_WAIT_S, False
        while True:
            try:
                found = read()
            except OSError as error:
                if error.errno not in _PASSING or wait_s > LONGEST_WAIT_S or not self.wait(wait_s):
                    raise
                wait_s, waited = 2.0 * wait_s, True
                continue
            if waited:
                with self._lock:
                    self._left_s = self._budget_s  # it was worth it
            return found, waited

    def wait(self, seconds: float) -> bool:
        """Sleep, unless all patience is spent; return whether it slept."""
        with self._lock:
            if self._left_s < seconds:
                return False
            self._left_s -= seconds
        self._sleep(seconds)
        return True


def stamp_of(path: Path) -> Stamp:
    """Return size and time of change of a file; raises `OSError`."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def settled(path: Path, patience: Patience) -> Stamp:
    """Return the stamp of a file once it stops changing, as far as patience goes; raises `OSError`."""
    stamp = stamp_of(path)
    while patience.wait(SETTLED_S):
        now = stamp_of(path)
        if now == stamp:
            break
        stamp = now
    return stamp
