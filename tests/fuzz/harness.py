"""Run a reader on mutated files and count what must not happen: foreign errors, long work, much memory."""

from __future__ import annotations

import random
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

from onthefly3r.errors import OnTheFly3RError

from .mutation import mutated
from .readers import Reader

LONG_S = 1.0  # of the processor's time: other work on the machine does not count
MUCH_BYTES = 1 << 30
KEPT_EXAMPLES = 20
NOTED_EVERY = 20


@dataclass(frozen=True)
class Outcome:
    """Counts of one reader."""

    inputs: int = 0
    read: int = 0
    refused: int = 0  # with an error of our own tree
    uncaught: int = 0
    long: int = 0
    large: int = 0
    crashes: int = 0
    examples: list[str] = field(default_factory=list)

    def __add__(self, other: Outcome) -> Outcome:
        """Add the counts."""
        return Outcome(**{item.name: getattr(self, item.name) + getattr(other, item.name) for item in fields(self)})

    @property
    def bad(self) -> int:
        """How many inputs ended as none may."""
        return self.uncaught + self.long + self.large + self.crashes

    def row(self, name: str) -> str:
        """Return the counts as a row of a table."""
        counts = (self.inputs, self.read, self.refused, self.uncaught, self.long, self.large, self.crashes)
        return f"| {name} | " + " | ".join(f"{count:,}" for count in counts) + " |"


def fuzz(
    reader: Reader,
    inputs: Iterable[int],
    seed: int = 0,
    keep: Path | None = None,
    progress: Callable[[int, Outcome], None] | None = None,
) -> Outcome:
    """Give a reader the inputs of these numbers; `keep` is a folder for those that end badly."""
    seeds = reader.seeds()
    total = Outcome()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / f"a{reader.suffix}"
        path.write_bytes(seeds[0])
        reader.read(path)  # imports do not count
        for index in inputs:
            data = mutated(seeds, random.Random(f"{reader.name} {seed} {index}"))
            path.write_bytes(data)
            if progress is not None and index % NOTED_EVERY == 0:
                progress(index, total)
            found = _one(reader, path, index)
            if found.bad and keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{reader.name} {seed} {index}{reader.suffix}").write_bytes(data)
            total = total + found
            if len(total.examples) > KEPT_EXAMPLES:
                del total.examples[KEPT_EXAMPLES:]
    if progress is not None:
        progress(index, total)
    return total


def _one(reader: Reader, path: Path, index: int) -> Outcome:
    before, start = _peak_bytes(), time.process_time()
    read = refused = uncaught = 0
    examples = []
    try:
        reader.read(path)
        read = 1
    except OnTheFly3RError:
        refused = 1
    except Exception:
        uncaught = 1
        last = traceback.format_exc().strip().splitlines()
        examples.append(f"{reader.name}, input {index}: {last[-1][:200]} ({last[-3].strip() if len(last) > 2 else ''})")
    took, grown = time.process_time() - start, _peak_bytes() - before
    if took > LONG_S:
        examples.append(f"{reader.name}, input {index}: {took:.1f} s")
    if grown > MUCH_BYTES:
        examples.append(f"{reader.name}, input {index}: {grown >> 20} MiB")
    return Outcome(1, read, refused, uncaught, int(took > LONG_S), int(grown > MUCH_BYTES), 0, examples)


def _peak_bytes() -> int:
    """Return the most memory that this process has had, 0 where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
