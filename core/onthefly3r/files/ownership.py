"""The stamp of an output folder: what in it was written by this package, and so may be replaced or removed by it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from .. import __version__
from ..errors import InputError
from .atomic import write_text
from .strict_json import loads

STAMP_NAME = "onthefly3r.json"
WORK = "work"
MAP = "map"  # group of the files in `work` that hold the map of a run
SURVEY = "survey"  # group of the photographs and the truth of a simulation
CRASH_NOTE = "crash.txt"  # among them
FORMAT = 1
MAX_STAMP_BYTES = 64 * 2**20
ENDS_BYTES = 16 * 2**20  # of a file that its fingerprint is taken from, at each end
SCRATCH = re.compile(r"work/(new|old|attempt)-[0-9a-f]{16}")


@dataclass(frozen=True)
class Listed:
    """One file that we wrote."""

    group: str  # of which files one verb replaces all: result, map, check, survey, flights, accuracy
    fingerprint: str = ""  # empty for a file that grows


@dataclass(frozen=True)
class Move:
    """One step of a publication: a file from the scratch folder to its name; without a source, it only goes away."""

    target: str
    source: str | None = None


@dataclass(frozen=True)
class Publication:
    """A swap of files that was begun: complete in the scratch folder, so that it can be ended after a power cut."""

    moves: tuple[Move, ...]
    files: Mapping[str, Listed]  # the whole list once it is done
    backup: str  # where the replaced files go until it is done


@dataclass
class Stamp:
    """What a folder holds of ours; names are relative to it, with slashes."""

    id: str = field(default_factory=lambda: secrets.token_hex(8))
    files: dict[str, Listed] = field(default_factory=dict)
    scratch: list[str] = field(default_factory=list)  # folders of ours with random names
    map_open: bool = False  # whether `work` holds, or may hold, the map of a run that has not ended
    publication: Publication | None = None

    @property
    def has_map(self) -> bool:
        """Whether what a map is made of in `work` is ours."""
        return self.map_open or self.publication is not None or any(i.group == MAP for i in self.files.values())

    def write(self, folder: Path) -> None:
        """Write the stamp; it is on the disk afterwards."""
        told = {"format": FORMAT, "software": f"onthefly3r {__version__}", **asdict(self)}
        write_text(folder / STAMP_NAME, json.dumps(told, indent=1, ensure_ascii=True) + "\n")


def read_stamp(folder: Path) -> Stamp | None:
    """Return the stamp of a folder, None without one.

    Raises `InputError` when the name is taken by something else, or the stamp is of a later release.
    """
    path = folder / STAMP_NAME
    if not os.path.lexists(path):
        return None
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_STAMP_BYTES:
            raise ValueError("not a file that this program writes")
        told = loads(path.read_text(encoding="utf-8"))
        if int(told["format"]) > FORMAT:
            raise InputError(f"{path}: was written by a later release ({told.get('software')}); use that one")
        return _stamp_from_json(told)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: is no stamp of ours ({error}); name another folder") from error


def holds_map(folder: Path) -> bool:
    """Return whether a folder's `work` holds a map of ours, so that a note for the developers may be left there."""
    try:
        stamp = read_stamp(folder)
        return stamp is not None and stamp.has_map and not (folder / WORK).is_symlink()
    except (InputError, OSError):
        return False


def products_in(folder: Path) -> set[Path]:
    """Return what a run of ours wrote into a folder, and its work folder; photographs of a simulated survey are none.

    Results of releases without a stamp are known by the record of their run.
    """
    record = folder / WORK / "run.json"
    old = {folder / WORK, folder / "preview.png"} if record.is_file() else set()
    try:
        stamp = read_stamp(folder)
    except (InputError, OSError):
        return old
    if stamp is None:
        return old
    return old | {folder / name for name, item in stamp.files.items() if item.group != SURVEY}


def fingerprint(path: Path) -> str:
    """Return a hash of a file's size, beginning and end, which tells whether it is still the one that was written."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as stream:
        digest.update(stream.read(ENDS_BYTES))
        if size > ENDS_BYTES:
            stream.seek(max(ENDS_BYTES, size - ENDS_BYTES))
            digest.update(stream.read(ENDS_BYTES))
    return digest.hexdigest()


def _stamp_from_json(told: Mapping[str, Any]) -> Stamp:
    publication = None
    if told["publication"] is not None:
        begun = told["publication"]
        moves = tuple(
            Move(_safe(move["target"]), None if move["source"] is None else _safe(move["source"]))
            for move in begun["moves"]
        )
        publication = Publication(moves, _files(begun["files"]), _scratch(begun["backup"]))
    return Stamp(
        id=str(told["id"]),
        files=_files(told["files"]),
        scratch=[_scratch(name) for name in told["scratch"]],
        map_open=bool(told["map_open"]),
        publication=publication,
    )


def _files(told: Mapping[str, Any]) -> dict[str, Listed]:
    return {_safe(name): Listed(str(item["group"]), str(item["fingerprint"])) for name, item in told.items()}


def _safe(name: Any) -> str:
    """Return a name that stays inside the folder; raises `ValueError` for any other: stamps may be forged."""
    parts = PurePosixPath(str(name)).parts
    if not parts or PurePosixPath(str(name)).is_absolute() or ".." in parts or re.search(r"[\\:\x00]", str(name)):
        raise ValueError(f"{name!r} leads out of the folder")
    return str(name)


def _scratch(name: Any) -> str:
    if not SCRATCH.fullmatch(str(name)):
        raise ValueError(f"{name!r} is no scratch folder of ours")
    return str(name)
