"""How long a job will still take, from how far it is; standard library only."""

from __future__ import annotations

import time
from collections.abc import Callable

SURE_AFTER_S = 8.0
SURE_FROM = 0.04  # share of the bar


class TimeLeft:
    """Estimates from the share that is done and the time that it took; says nothing before that means anything."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began_s = clock()

    def text(self, share: float) -> str:
        """Return the time left in words for a share between 0 and 1, empty while it is not known."""
        elapsed_s = self._clock() - self._began_s
        if elapsed_s < SURE_AFTER_S or not SURE_FROM <= share < 1.0:
            return ""
        return f"{in_words(elapsed_s * (1.0 - share) / share)} left"


def in_words(seconds: float) -> str:
    """Return a duration as a person says it."""
    if seconds < 45.0:
        return "less than a minute"
    minutes = max(1, round(seconds / 60.0))
    if minutes < 60:
        return f"about {minutes} minute{'s' if minutes > 1 else ''}"
    hours, rest = divmod(round(minutes / 5.0) * 5, 60)
    return f"about {hours} h {rest} min" if rest else f"about {hours} h"
