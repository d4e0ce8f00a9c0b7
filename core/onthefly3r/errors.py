"""What can go wrong and who can mend it.

    OnTheFly3RError              anything this package raises on purpose
    ├── InputError               the caller's input is wrong: says what, where and how to mend it (exit 2)
    │   ├── OptionError          an option's name or value
    │   ├── PhotographError      one photograph cannot be used (reported, never fatal for the others)
    │   ├── ReferenceFormatError a reference model, trajectory, cloud or position file
    │   ├── BusyError            another process works in the output folder
    │   └── MissingDependencyError the interpreter lacks a package or a system library
    ├── ReconstructionError      nothing could be reconstructed (exit 3, the report is still written)
    │   ├── GeoreferenceError    the map cannot be tied to the Earth (exit 3, the report is still written)
    │   ├── MisfitError          the result contradicts itself or its positions by far (exit 3, files are written)
    │   └── IncompleteError      fewer than half of the photographs are placed (exit 5, files are written)
    ├── StorageError             no room on the disk or no access to a file (exit 4)
    └── Cancelled                the caller asked to stop (exit 130)

A local model that does not fit the map is no exception: see `records.Rejection`.
"""

from __future__ import annotations

from pathlib import Path


class OnTheFly3RError(Exception):
    """Anything this package raises on purpose."""

    exit_code = 1
    way_on = ""  # what can be done with what is there


class InputError(OnTheFly3RError):
    """The caller's input is wrong; the message says what, where and how to mend it."""

    exit_code = 2


class OptionError(InputError):
    """An option's name or value is wrong."""


class PhotographError(InputError):
    """One photograph cannot be used; the run goes on without it."""

    def __init__(self, image: str, reason: str) -> None:
        super().__init__(f"{image}: {reason}")
        self.image = image
        self.reason = reason


class ReferenceFormatError(InputError):
    """A reference model, trajectory, cloud or position file cannot be read."""


class BusyError(InputError):
    """Another process works in the output folder; the message names it."""


class MissingDependencyError(InputError):
    """The interpreter lacks a package or a system library that the request needs."""


class ReconstructionError(OnTheFly3RError):
    """Nothing could be reconstructed from the photographs."""

    exit_code = 3
    report: Path | None = None  # that says more


class GeoreferenceError(ReconstructionError):
    """The map cannot be tied to the Earth with the positions at hand."""


class MisfitError(ReconstructionError):
    """The result contradicts itself or its positions by far; its files are written all the same."""


class IncompleteError(ReconstructionError):
    """Fewer than half of the photographs are placed; the files of those that are, are written."""

    exit_code = 5


class StorageError(OnTheFly3RError):
    """There is no room on the disk or no access to a file; what was there before is as it was."""

    exit_code = 4


def require_memory(error: ImportError | OSError) -> None:
    """Raise `MemoryError` when a module could not be loaded because memory lacks, which looks as if it were missing."""
    signs = ("cannot allocate memory", "failed to map segment", "out of memory", "not enough memory", "paging file")
    if any(sign in str(error).lower() for sign in signs):
        raise MemoryError(f"no memory is left to load a library ({error})") from error


class Cancelled(OnTheFly3RError):
    """The caller asked to stop."""

    exit_code = 130
