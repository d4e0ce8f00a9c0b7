"""Fuzz all readers, or some, and print a table of what was found.

    PYTHONPATH=core:tests python -m fuzz --inputs 40000 [--reader NAME] [--seed 0] [--keep FOLDER]

Every reader runs in a process of its own, so that one that crashes or hangs is counted and not suffered.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from .harness import Outcome, fuzz
from .readers import READERS

HANG_S = 120.0  # without an answer for that long the process is ended


def main() -> int:
    """Run and return how many inputs ended badly, at most 1."""
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=40_000, help="of all readers together")
    parser.add_argument("--reader", action="append", help="name of a reader; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for inputs that ended badly")
    chosen = parser.parse_args()
    readers = [reader for reader in READERS if not chosen.reader or reader.name in chosen.reader]
    total = Outcome()
    print("| reader | inputs | read | refused | uncaught errors | over 1 s | over 1 GiB | crashes |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for reader in readers:
        found = in_processes(reader.name, chosen.inputs // len(readers), chosen.seed, chosen.keep)
        total = total + found
        print(found.row(reader.name), flush=True)
    print(total.row("all"))
    for text in total.examples:
        print(text, file=sys.stderr)
    return int(total.bad > 0)


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


if __name__ == "__main__":
    sys.exit(main())
