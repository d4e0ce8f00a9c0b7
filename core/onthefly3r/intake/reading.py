"""A folder of photographs as a run takes it: shots with their positions, what was refused, and what is to be told."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import ReferenceFormatError
from ..options import Options
from ..records import RefusedPhotograph, Shot
from .folder import files_in, find_photographs, read_photographs
from .positions_file import read_positions, with_positions
from .recognise import FRAMES_HELP, HEIC, RAW, VIDEO

MOST_TABLES, MOST_TABLE_BYTES = 20, 4 << 20  # text files beside the photographs that are looked at
KINDS_TOLD = 12  # of warnings of single photographs


@dataclass(frozen=True)
class Flight:
    """The photographs of one folder."""

    shots: tuple[Shot, ...]
    refused: tuple[RefusedPhotograph, ...]
    warnings: tuple[str, ...]


def read_flight(folder: Path, options: Options, leave_out: Path | None = None) -> Flight:
    """Read a folder of photographs and, where the options name one, their position file.

    Raises `InputError` when the folder, the position file or an option is wrong.
    """
    shots, refused = read_photographs(folder, options.intake, leave_out)
    file = options.georeference.positions
    told: list[str] = []
    if file is not None:
        shots, told = with_positions(shots, read_positions(Path(file)))
    else:
        told = _tables_beside(folder, shots, options.intake.recursive, leave_out)
    told += shot_warnings(shots, tags_place=file is None)
    told += _other_files(folder, options.intake.recursive, leave_out)
    return Flight(tuple(shots), tuple(refused), tuple(told))


def shot_warnings(shots: Sequence[Shot], tags_place: bool = True) -> list[str]:
    """Return what the tags of single photographs gave rise to, each kind once with its number of photographs.

    Args:
        shots: of one flight.
        tags_place: false where positions come from a file; what is odd about those in the tags is then not told.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for shot in shots:
        for text in shot.warnings:
            if tags_place or not _about_place(text):
                kinds.setdefault(re.sub(r"[-+]?\d[\d.e+-]*", "#", text), []).append((shot.name, text))
    told = []
    for found in sorted(kinds.values(), key=len, reverse=True)[:KINDS_TOLD]:
        name, text = found[0]
        told.append(f"{name}: {text}" if len(found) == 1 else f"{len(found)} of {len(shots)} photographs: {text}")
    if len(kinds) > KINDS_TOLD:
        told.append(f"{len(kinds) - KINDS_TOLD} further kinds of oddities in tags: 'onthefly3r check' lists all")
    deep = [shot for shot in shots if shot.value_range is not None]
    if deep:
        low = min(shot.value_range[0] for shot in deep if shot.value_range)
        high = max(shot.value_range[1] for shot in deep if shot.value_range)
        told.append(
            f"{len(deep)} photographs have more than 8 bits per channel: values from {low:.0f} to {high:.0f} were "
            "stretched to 8 bits, alike in all photographs of a camera"
        )
    return told


def _about_place(text: str) -> bool:
    return any(word in text for word in ("position", "height", "GPSL", "AltitudeType"))


def _tables_beside(folder: Path, shots: Sequence[Shot], recursive: bool, leave_out: Path | None) -> list[str]:
    """Notice position files among the photographs: they are often better than the tags."""
    told = []
    tables = [path for path in files_in(folder, recursive, {".txt", ".csv"}, leave_out) if _is_small(path)]
    for path in tables[:MOST_TABLES]:
        name = path.relative_to(folder).as_posix()
        try:
            found, _ = with_positions(shots, read_positions(path))
        except ReferenceFormatError as error:
            if path.stem.lower() == "geo":
                told.append(f"{name} beside the photographs is not used; as a position file it has a fault: {error}")
            continue
        placed = sum(shot.gps is not None for shot in found)
        told.append(
            f"{name} beside the photographs lists positions of {placed} of {len(shots)} of them and is not used: name "
            f"it with --positions if they are better than those in the tags"
        )
    return told


def _is_small(path: Path) -> bool:
    try:
        return path.is_file() and path.stat().st_size <= MOST_TABLE_BYTES
    except OSError:
        return False


def _other_files(folder: Path, recursive: bool, leave_out: Path | None) -> list[str]:
    told = []
    videos = files_in(folder, recursive, VIDEO, leave_out)
    if videos:
        told.append(f"{len(videos)} videos such as {videos[0].name} were left out; {FRAMES_HELP}")
    pairs = set(files_in(folder, recursive, HEIC | RAW, leave_out)) - set(
        find_photographs(folder, recursive, leave_out)
    )
    if pairs:
        told.append(f"{len(pairs)} raw or HEIC files were left out: a JPEG, PNG or TIFF of the same name is used")
    marks = files_in(folder, recursive, {".mrk"}, leave_out)
    if marks:
        told.append(
            f"{marks[0].name} holds the times of the exposures for a correction after the flight (PPK); it is not "
            "used: give corrected positions with --positions"
        )
    return told
