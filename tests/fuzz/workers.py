"""Readers in processes of their own: one that crashes or hangs is counted, and the next input goes on."""

from __future__ import annotations

import json
import multiprocessing
import tempfile
from dataclasses import asdict
from pathlib import Path

from .harness import Outcome, fuzz
from .readers import READERS

HANG_S = 300.0  # without a sign of life for that long the process is ended


def in_processes(name: str, inputs: int, seed: int, keep: Path | None) -> Outcome:
    """Fuzz one reader in a process of its own; after a crash another process goes on with the next input."""
    total, start = Outcome(), 0
    context = multiprocessing.get_context("spawn")
    while start < inputs:
        with tempfile.TemporaryDirectory() as folder:
            note = Path(folder) / "note.json"
            worker = context.Process(target=_work, args=(name, start, inputs, seed, keep, note))
            worker.start()
            last = -1
            while worker.is_alive():
                worker.join(HANG_S)
                done = _read(note)[0]
                if worker.is_alive() and done == last:
                    worker.kill()
                last = done
            if not note.exists():
                raise RuntimeError(f"{name}: the process did not start")
            done, outcome = _read(note)
            total = total + outcome
            if worker.exitcode == 0:
                break
            total = total + Outcome(inputs=1, crashes=1, examples=[f"{name}: input {done} of seed {seed} crashes"])
            start = done + 1
    return total


def _work(name: str, start: int, end: int, seed: int, keep: Path | None, note: Path) -> None:
    reader = next(reader for reader in READERS if reader.name == name)

    def progress(index: int, outcome: Outcome) -> None:
        note.write_text(json.dumps([index, asdict(outcome)]))

    fuzz(reader, range(start, end), seed, keep, progress)


def _read(note: Path) -> tuple[int, Outcome]:
    try:
        index, values = json.loads(note.read_text())
        return int(index), Outcome(**values)
    except (OSError, ValueError):
        return 0, Outcome()
