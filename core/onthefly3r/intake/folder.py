"""A folder of photographs to shots in capture order; whatever cannot be used is named with its reason."""

from __future__ import annotations

import hashlib
import os
import random
from collections import defaultdict
from pathlib import Path

from ..errors import InputError, PhotographError
from ..options import IntakeOptions
from ..records import RefusedPhotograph, Shot
from .metadata import read_shot
from .opening import SUFFIXES


def read_photographs(
    folder: Path, options: IntakeOptions, leave_out: Path | None = None
) -> tuple[list[Shot], list[RefusedPhotograph]]:
    """Return the shots of a folder by capture time then name, and the files that were refused.

    Shots without a capture time come last. `options.limit` cuts in capture order, before any shuffling.
    Raises `InputError` when the folder is missing or holds no photograph by its suffixes.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder that holds the photographs")
    paths = find_photographs(folder, options.recursive, leave_out)
    if not paths:
        where = "it or its sub-folders" if options.recursive else "it (sub-folders are not searched)"
        raise InputError(f"{folder}: no JPEG, PNG or TIFF file in {where}")
    refused = _duplicates(folder, paths)
    shots: list[Shot] = []
    for path in paths:
        name = path.relative_to(folder).as_posix()
        if name in refused:
            continue
        try:
            shots.append(read_shot(path, name, options))
        except PhotographError as error:
            refused[name] = RefusedPhotograph(name, error.reason)
        except OSError as error:
            refused[name] = RefusedPhotograph(name, f"cannot be read ({error.strerror or type(error).__name__})")
    shots.sort(key=lambda shot: shot.capture_order)
    shots = shots[: options.limit]
    if options.shuffle_seed is not None:
        random.Random(options.shuffle_seed).shuffle(shots)  # noqa: S311 (an order for tests, no secret)
    return shots, [refused[name] for name in sorted(refused)]


def find_photographs(folder: Path, recursive: bool, leave_out: Path | None = None) -> list[Path]:
    """Return the files with a photograph's suffix, sorted by name.

    Hidden files and folders are left out, and the folder `leave_out`: results that lie among the photographs.
    """
    found: list[Path] = []
    results = None if leave_out is None else leave_out.resolve()
    for parent, folders, names in os.walk(folder):
        inner = sorted(name for name in folders if not name.startswith(".") and Path(parent, name).resolve() != results)
        folders[:] = inner if recursive else []
        found += [
            Path(parent, name)
            for name in names
            if not name.startswith(".") and os.path.splitext(name)[1].lower() in SUFFIXES  # noqa: PTH122
        ]
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def _duplicates(folder: Path, paths: list[Path]) -> dict[str, RefusedPhotograph]:
    """Return the files whose bytes repeat an earlier one's; only files of equal size are read."""
    by_size: dict[int, list[Path]] = defaultdict(list)
    for path in paths:
        try:
            by_size[path.stat().st_size].append(path)
        except OSError:
            continue  # a vanished file or dangling link is refused when it is opened
    refused: dict[str, RefusedPhotograph] = {}
    for same_size in by_size.values():
        if len(same_size) < 2:
            continue
        first: dict[str, str] = {}
        for path in same_size:
            name = path.relative_to(folder).as_posix()
            try:
                digest = _digest(path)
            except OSError:
                continue
            kept = first.setdefault(digest, name)
            if kept != name:
                refused[name] = RefusedPhotograph(name, f"the same file as {kept}")
    return refused


def _digest(path: Path) -> str:
    digest = hashlib.blake2b()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
