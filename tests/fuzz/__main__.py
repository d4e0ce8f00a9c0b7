"""Fuzz all readers, or some, and print a table of what was found.

    PYTHONPATH=core:tests python -m fuzz --inputs 40000 [--reader NAME] [--seed 0] [--keep FOLDER]

Every reader runs in a process of its own, so that one that crashes or hangs is counted and not suffered.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .harness import Outcome
from .readers import READERS
from .workers import in_processes


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


if __name__ == "__main__":
    sys.exit(main())
