"""A folder of photographs to shots in capture order; whatever cannot be used is named with its reason."""

from __future__ import annotations

import hashlib
import os
import random
from collections import defaultdict
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from ..errors import InputError, PhotographError
from ..files.ownership import products_in
from ..files.regular import open_regular
from ..options import IntakeOptions
from ..records import RefusedPhotograph, Shot
from .deep import with_common_range
from .metadata import read_shot
from .recognise import FRAMES_HELP, JPEG_PNG_TIFF, SUFFIXES, VIDEO
from .stamp import Patience

HEADER_PATIENCE_S = 6.0


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
        raise InputError(_nothing_found(folder, options.recursive, leave_out))
    refused = _duplicates(folder, paths)
    shots: list[Shot] = []
    patience = Patience(HEADER_PATIENCE_S)
    for path in paths:
        name = path.relative_to(folder).as_posix()
        if name in refused:
            continue
        found = _read(path, name, options, patience)
        if isinstance(found, Shot):
            shots.append(found)
        else:
            refused[name] = found
    shots.sort(key=lambda shot: shot.capture_order)
    shots = with_common_range(shots[: options.limit])
    if options.shuffle_seed is not None:
        random.Random(options.shuffle_seed).shuffle(shots)  # noqa: S311 (an order for tests, no secret)
    return shots, [refused[name] for name in sorted(refused)]


def find_photographs(folder: Path, recursive: bool, leave_out: Path | None = None) -> list[Path]:
    """Return the files with a photograph's suffix, sorted by name.

    Hidden files and folders are left out, and the folder `leave_out`: results that lie among the photographs. A raw
    or HEIC file beside a JPEG, PNG or TIFF of the same name is the same photograph and left out too.
    """
    found = files_in(folder, recursive, SUFFIXES, leave_out)
    plain = {path.with_suffix("") for path in found if path.suffix.lower() in JPEG_PNG_TIFF}
    return [path for path in found if path.suffix.lower() in JPEG_PNG_TIFF or path.with_suffix("") not in plain]


def files_in(folder: Path, recursive: bool, suffixes: Collection[str], leave_out: Path | None = None) -> list[Path]:
    """Return the files with one of these suffixes (lower case, with the dot), sorted by name, hidden ones left out.

    What a run of ours wrote into a folder among them, such as its preview, is left out too.
    """
    found: list[Path] = []
    products: set[Path] = set()
    results = None if leave_out is None else leave_out.resolve()
    for parent, folders, names in os.walk(folder):
        products |= products_in(Path(parent))
        inner = sorted(
            name
            for name in folders
            if not name.startswith(".")
            and Path(parent, name) not in products
            and Path(parent, name).resolve() != results
        )
        folders[:] = inner if recursive else []
        found += [
            Path(parent, name)
            for name in names
            if not name.startswith(".")
            and Path(parent, name) not in products
            and os.path.splitext(name)[1].lower() in suffixes  # noqa: PTH122
        ]
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def _read(path: Path, name: str, options: IntakeOptions, patience: Patience) -> Shot | RefusedPhotograph:
    """Return the shot of a file, or why there is none: whatever goes wrong with one photograph stays with it."""
    try:
        dangling = path.is_symlink() and not path.exists()  # nothing to wait for
        shot, waited = (Patience(0.0) if dangling else patience).attempt(lambda: read_shot(path, name, options))
    except PhotographError as error:
        return RefusedPhotograph(name, error.reason)
    except OSError as error:
        return RefusedPhotograph(name, f"cannot be read ({error.strerror or type(error).__name__})")
    except MemoryError:
        return RefusedPhotograph(name, "there is not enough memory to read its tags; close other programs")
    except Exception as error:  # a tag that nobody thought of
        return RefusedPhotograph(name, f"its tags cannot be read ({type(error).__name__}: {str(error)[:200]})")
    if waited:
        shot = replace(shot, warnings=(*shot.warnings, "the file could not be read for a moment and was waited for"))
    return shot


def _nothing_found(folder: Path, recursive: bool, leave_out: Path | None) -> str:
    where = "it or its sub-folders" if recursive else "it (sub-folders are not searched)"
    videos = files_in(folder, recursive, VIDEO, leave_out)
    if videos:
        return f"{folder}: no photograph in {where}, but {len(videos)} videos such as {videos[0].name}: {FRAMES_HELP}"
    return f"{folder}: no JPEG, PNG or TIFF file in {where}"


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
    with open_regular(path) as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
