"""What crosses the border between a caller in another process and the core: a job in, one JSON object per line out.

Standard library only: QGIS imports this module in its own process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Progress:
    """How far a run is; counts are images."""

    stage: str
    done: int
    total: int
    placed: int = 0
    rejected: int = 0
    waiting: int = 0
    eta_s: float | None = None
    message: str = ""


@dataclass(frozen=True)
class Event:
    """One line of the `--json` stream: kind is progress, warning, result or error."""

    kind: str
    data: dict[str, Any]
    time_s: float = field(default_factory=time.time)

    def to_line(self) -> str:
        """Return the event as one line of JSON without a line break."""
        return json.dumps({"kind": self.kind, "time_s": round(self.time_s, 3), **self.data}, ensure_ascii=False)

    @classmethod
    def from_line(cls, line: str) -> Event:
        """Parse one line; raises `ValueError` when it is not one of ours."""
        data = json.loads(line)
        if not isinstance(data, dict) or not isinstance(data.get("kind"), str):
            raise ValueError(f"not an event: {line[:80]!r}")
        kind, time_s = data.pop("kind"), float(data.pop("time_s", 0.0))
        return cls(kind, data, time_s)

    @classmethod
    def progress(cls, progress: Progress) -> Event:
        """Wrap a progress report."""
        return cls("progress", asdict(progress))


ProgressCallback = Callable[[Progress], None]
