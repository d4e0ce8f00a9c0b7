"""What crosses the border between a caller in another process and the core: a job in, one JSON object per line out.

Standard library only: QGIS imports this module in its own process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .errors import InputError
from .files.strict_json import loads

MAX_JOB_BYTES = 1024 * 1024


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
        data = loads(line)
        if not isinstance(data, dict) or not isinstance(data.get("kind"), str):
            raise ValueError(f"not an event: {line[:80]!r}")
        kind, time_s = data.pop("kind"), float(data.pop("time_s", 0.0))
        return cls(kind, data, time_s)

    @classmethod
    def progress(cls, progress: Progress) -> Event:
        """Wrap a progress report."""
        return cls("progress", asdict(progress))


ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True)
class Job:
    """A command for the core in another process: a verb of the command line, its arguments and its options.

    `arguments` are positional; `options` have the names of `options.py` or of the verb, None leaves the default.
    """

    verb: str
    arguments: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)

    def words(self) -> list[str]:
        """Return the words of the command line; the double dash lets arguments begin with a dash."""
        words = [self.verb]
        for name, value in self.options.items():
            flag = name.replace("_", "-")
            if isinstance(value, bool):
                words.append(f"--{flag}" if value else f"--no-{flag}")
            elif isinstance(value, (list, tuple)):
                words += [f"--{flag}={item}" for item in value]
            elif value is not None:
                words.append(f"--{flag}={value}")
        return [*words, "--json", "--", *self.arguments]

    def write(self, path: Path) -> None:
        """Write the job as JSON; ASCII only, so that a file name that is no text comes through as it is."""
        path.write_text(json.dumps(asdict(self), indent=1), encoding="ascii")

    @classmethod
    def read(cls, path: Path) -> Job:
        """Read what `write` wrote; raises `InputError` for anything else."""
        try:
            if path.stat().st_size > MAX_JOB_BYTES:
                raise ValueError(f"larger than {MAX_JOB_BYTES} bytes")
            data = loads(path.read_text(encoding="utf-8"))
            verb, arguments, options = data["verb"], tuple(map(str, data["arguments"])), dict(data["options"])
            if not isinstance(verb, str) or not verb.isidentifier():
                raise ValueError(f"{verb!r} is no verb")
            return cls(verb, arguments, options)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is not a job ({error}); write it with onthefly3r.protocol.Job.write") from error
