"""The map on disk: one chunk per committed batch, and a journal whose line makes the chunk count.

A chunk is written under a temporary name and renamed; only then the journal line follows. What the journal does
not name was never committed, so a run that is killed at any moment leaves a map that can be read. The first line says
format and software, and each line begins with the checksum of its JSON; chunks are ZIP files, which have their own.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..errors import InputError
from ..files.array_file import ArrayFile
from ..files.strict_json import loads
from ..geometry.arrays import Float, UInt8
from ..records import CompactReference, NewFrame, Observations, Submap
from .journal import submap_to_json

FORMAT = 2  # 1, of release 0.1, had neither a first line that says so nor checksums
CACHED_REFERENCES = 256  # about 40 KB each


@dataclass(frozen=True)
class StoredPoints:
    """The points of one frame as they were predicted."""

    index: int  # shot
    submap: int
    points: Float  # (N, 3) float32, submap frame
    rgb: UInt8  # (N, 3)
    confidence: UInt8  # (N,) 0..255


class Store:
    """Chunks and journal of one run; compact references are cached, points are only streamed."""

    def __init__(self, work: Path, partial: bool = False) -> None:
        """`partial` reads what is undamaged and notes in `lost` what is not; it is for reading only."""
        self._partial = partial
        self.lost: list[str] = []
        self._damaged_chunks: set[int] = set()
        self._chunks = work / "chunks"
        self._journal = work / "journal.jsonl"
        self._chunk_of: dict[int, int] = {}
        self._submaps: list[int] = []
        self._recent: OrderedDict[int, CompactReference] = OrderedDict()

    @property
    def has_journal(self) -> bool:
        """Whether anything was written."""
        return self._journal.exists() and self._journal.stat().st_size > 0

    def commit(self, submap: Submap, frames: Sequence[NewFrame], observations: Observations | None = None) -> None:
        """Write one batch: the chunk first, then the journal line that makes it count."""
        arrays: dict[str, Any] = {}
        for new in frames:
            prefix = str(new.frame.index)
            arrays[f"{prefix}/reference_pixels"] = new.reference.pixels
            arrays[f"{prefix}/reference_points"] = new.reference.points
            arrays[f"{prefix}/reference_confidence"] = new.reference.confidence
            arrays[f"{prefix}/points"] = new.points
            arrays[f"{prefix}/rgb"] = new.rgb
            arrays[f"{prefix}/confidence"] = new.confidence
        if observations is not None:
            arrays |= {f"observations/{name}": value for name, value in vars(observations).items()}
        self._chunks.mkdir(parents=True, exist_ok=True)
        path = self._chunk_path(submap.number)
        temporary = path.with_suffix(".part.npz")
        with temporary.open("wb") as stream:
            np.savez(stream, **arrays)
            stream.flush()
            os.fsync(stream.fileno())  # the journal must not name what a power cut took
        temporary.replace(path)
        self.note("submap", submap_to_json(submap))
        self._submaps.append(submap.number)
        for new in frames:
            self._chunk_of[new.frame.index] = submap.number
            self._remember(new.frame.index, new.reference)

    def note(self, kind: str, value: Any) -> None:
        """Append one line to the journal and wait until it is on disk."""
        self._journal.parent.mkdir(parents=True, exist_ok=True)
        with self._journal.open("ab") as journal:
            if journal.tell() == 0:
                journal.write(_line("journal", {"format": FORMAT, "software": __version__}))
            journal.write(_line(kind, value))
            journal.flush()
            os.fsync(journal.fileno())

    def end_step(self, value: Any) -> None:
        """Append the line that ends a step of the engine: a run that was stopped goes on from the last one."""
        self.note("step", value)

    def rewind(self) -> list[Any]:
        """Cut the journal after its last step, so that the run can go on from there; return the values of all steps.

        What follows the last step was begun and is done again; of a journal without any, nothing is cut but a torn
        first line. Raises `InputError` for a journal that is damaged before its end.
        """
        steps, end, kinds = [], 0, set()
        for kind, value, after in self._lines():
            kinds.add(kind)
            if kind == "step":
                steps.append(value)
                end = after
        if steps or kinds <= {"journal"}:
            with self._journal.open("r+b") as journal:
                journal.truncate(end)
                journal.flush()
                os.fsync(journal.fileno())
        return steps

    def replay(self) -> Iterator[tuple[str, Any]]:
        """Yield the journal's lines as (kind, JSON value), oldest first; raises `InputError` for a damaged one.

        A last line without its end was being written when the run was killed: it never counted.
        """
        for kind, value, _ in self._lines():
            if kind == "submap":
                self._submaps.append(int(value.get("number", 0)))  # a damaged one is told by who reads it
                self._chunk_of.update({int(f["index"]): int(value["number"]) for f in value["frames"]})
            yield kind, value

    def _lines(self) -> Iterator[tuple[str, Any, int]]:
        """Yield kind, value and where it ends, in bytes, of each line of the journal."""
        if not self._journal.exists():
            raise InputError(f"{self._journal} is missing: this folder holds no map; name the output folder of a run")
        end, checked = 0, False
        with self._journal.open("rb") as journal:
            for number, line in enumerate(journal, start=1):
                if not line.endswith(b"\n"):
                    return
                try:
                    kind, value = _parsed(line, checked)
                except (ValueError, AttributeError, RecursionError) as error:
                    where = f"{self._journal}, line {number}: damaged ({error})"
                    if self._partial:
                        self.lost.append(f"{where}: what was placed after it is left out")
                        return
                    raise InputError(
                        f"{where}; 'onthefly3r export {self._journal.parent.parent} NEW-FOLDER --partial' writes what "
                        f"was placed before it, {len(self._chunk_of)} photographs; or run again"
                    ) from error
                if kind == "journal":
                    checked = True
                    if int(value["format"]) > FORMAT:
                        raise InputError(f"{self._journal}: was written by a later release, {value['software']}")
                end += len(line)
                yield kind, value, end

    def look_at_chunks(self) -> None:
        """Note in `lost` which chunks are missing or damaged; the points of their photographs are left out."""
        for submap in self._submaps:
            path = self._chunk_path(submap)
            try:
                with zipfile.ZipFile(path) as chunk:
                    damaged = chunk.testzip() is not None
            except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
                damaged = True
            if damaged:
                self._damaged_chunks.add(submap)
                photographs = sum(number == submap for number in self._chunk_of.values())
                self.lost.append(
                    f"{path} is missing or damaged: the points of its {photographs} photographs are left out"
                )

    def reference(self, index: int) -> CompactReference:
        """Return H_i of an accepted frame (Eq. 2), points in the frame of its submap."""
        if index in self._recent:
            self._recent.move_to_end(index)
            return self._recent[index]
        if self._chunk_of[index] in self._damaged_chunks:
            nothing = np.zeros((0, 3), np.float32)
            return CompactReference(np.zeros((0, 2), np.int32), nothing, nothing[:, 0])
        with ArrayFile(self._chunk_path(self._chunk_of[index])) as chunk:
            reference = CompactReference(
                chunk[f"{index}/reference_pixels"],
                chunk[f"{index}/reference_points"],
                chunk[f"{index}/reference_confidence"],
            )
        self._remember(index, reference)
        return reference

    def stream_points(self) -> Iterator[StoredPoints]:
        """Yield the points of all frames, one frame in memory at a time."""
        for index, submap in self._chunk_of.items():
            if submap in self._damaged_chunks:
                continue
            with ArrayFile(self._chunk_path(submap)) as chunk:
                yield StoredPoints(
                    index, submap, chunk[f"{index}/points"], chunk[f"{index}/rgb"], chunk[f"{index}/confidence"]
                )

    def stream_observations(self) -> Iterator[tuple[int, Observations]]:
        """Yield what the backbone tied together in each submap, by its number; nothing where it does not tell."""
        names = [field.name for field in fields(Observations)]
        for submap in self._submaps:
            if submap in self._damaged_chunks:
                continue
            with ArrayFile(self._chunk_path(submap)) as chunk:
                if f"observations/{names[0]}" in chunk:
                    yield submap, Observations(**{name: chunk[f"observations/{name}"] for name in names})

    def _chunk_path(self, submap: int) -> Path:
        return self._chunks / f"{submap:06d}.npz"

    def _remember(self, index: int, reference: CompactReference) -> None:
        self._recent[index] = reference
        self._recent.move_to_end(index)
        while len(self._recent) > CACHED_REFERENCES:
            self._recent.popitem(last=False)


def _line(kind: str, value: Any) -> bytes:
    text = json.dumps({kind: value}).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _parsed(line: bytes, checked: bool) -> tuple[str, Any]:
    """Return kind and value of a line, of format 1 too unless it must be `checked`; raises `ValueError`."""
    text = line.rstrip(b"\n")
    if checked or not text.startswith(b"{"):
        sum_told, _, text = text.partition(b" ")
        if sum_told != b"%08x" % zlib.crc32(text):
            raise ValueError("its checksum does not fit")
    ((kind, value),) = loads(text).items()
    return kind, value
