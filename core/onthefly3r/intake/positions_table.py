"""The lines of a position file: which separator it uses, and the name and numbers of each line.

Spaces, tabs, semicolons and commas separate columns; a comma may be the decimal sign where it separates nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import ReferenceFormatError
from ..files.regular import read_regular

MAX_FILE_BYTES = 64 * 1024 * 1024
TRIED_LINES = 200  # that decide which separator it is
MOST_NUMBERS = 8
COLUMNS = "name x y [z] [yaw pitch roll] [sigma_h sigma_v]"
_SPACES = " "
_COMMENT = re.compile(r"(?:^|\s)#.*")
_SUFFIX = re.compile(r"\.(?:jpe?g|jpe|png|tiff?|dng|hei[cf]|arw|cr[23]|nef|mpo)[\"']?$", re.IGNORECASE)
_ORDERS = {"x": 0, "lon": 0, "east": 0, "y": 1, "lat": 1, "north": 1}


@dataclass(frozen=True)
class Row:
    """One line of the file: `numbers` are x y [z] [yaw pitch roll] [sigma_h sigma_v], NaN where it says nan."""

    where: str  # file and line, for messages
    name: str
    numbers: tuple[float, ...]


def read_table(path: Path) -> tuple[str, list[Row]]:
    """Return the first line, which names the CRS, and the rows; raises `ReferenceFormatError` with the line."""
    try:
        text = _decoded(read_regular(path, MAX_FILE_BYTES)).lstrip("\ufeff")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ReferenceFormatError(f"{path} cannot be read ({reason}); give a geo.txt in UTF-8") from error
    lines = [
        (number, kept)
        for number, line in enumerate(re.split(r"\r\n|\r|\n", text), start=1)
        if (kept := _COMMENT.sub("", line).strip(" \t\0\x0b\x0c"))
    ]
    if len(lines) < 2:
        raise ReferenceFormatError(f"{path}: no positions; first a line with the CRS, then one line per photograph")
    first = lines[0][1].strip(" \t,;\"'")
    rows = lines[1:]
    separator = _separator([line for _, line in rows[:TRIED_LINES]])
    if _is_heading(rows[0][1], separator, path, rows[0][0]):
        rows = rows[1:]
    return first, [_row(line, separator, f"{path}, line {number}") for number, line in rows]


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if b"\0" in data[:4096]:
            raise
        return data.decode("cp1252")  # what spreadsheets write on Windows


def _separator(lines: Sequence[str]) -> str:
    """Return the separator with which most lines hold a name and at least two numbers."""
    candidates = (";", "\t", _SPACES, ",")
    counts = [sum(len(_split(line, candidate)[1]) >= 2 for line in lines) for candidate in candidates]
    if max(counts) > 0:
        return candidates[counts.index(max(counts))]
    return next((c for c in (";", "\t", ",") if sum(c in line for line in lines) > len(lines) / 2), _SPACES)


def _row(line: str, separator: str, where: str) -> Row:
    name, words = _split(line, separator)
    numbers = [_number(word, separator) for word in words]
    if len(numbers) < 2 or not name:
        raise ReferenceFormatError(f"{where}: expected {COLUMNS}, found {line[:80]!r}")
    if len(numbers) not in (2, 3, 6, MOST_NUMBERS):
        raise ReferenceFormatError(f"{where}: {len(numbers)} numbers after the name; 2, 3, 6 or 8 are allowed")
    if any(math.isinf(number) for number in numbers):
        raise ReferenceFormatError(f"{where}: an infinite number; write nan for what is not known")
    if any(math.isnan(number) for number in numbers[:2]):
        raise ReferenceFormatError(f"{where}: x or y is nan; leave the line out where there is no position")
    return Row(where, name, tuple(numbers))


def _split(line: str, separator: str) -> tuple[str, list[str]]:
    """Return the name and the words that are numbers; words after the first that is none are remarks."""
    if separator == _SPACES:
        words = line.split()
        end = next((k for k, word in enumerate(words) if _SUFFIX.search(word)), 0)  # names may hold spaces
        name, rest = " ".join(words[: end + 1]), words[end + 1 :]
    else:
        name, *rest = line.split(separator)
        while rest and not rest[-1].strip():
            rest.pop()  # spreadsheets fill lines up with separators
    found: list[str] = []
    for word in rest:
        if math.isnan(_number(word, separator)) and word.strip(" \"'").lower() not in ("nan", "+nan", "-nan"):
            break
        found.append(word)
    return name.strip(" \"'"), found[:MOST_NUMBERS]


def _number(word: str, separator: str) -> float:
    """Return a number, NaN for what is none; a comma is a decimal sign unless it separates columns."""
    word = word.strip(" \"'")
    if len(word) > 40 or "_" in word:
        return math.nan
    if separator != "," and word.count(",") == 1 and "." not in word:
        word = word.replace(",", ".")
    try:
        return float(word)
    except ValueError:
        return math.nan


def _is_heading(line: str, separator: str, path: Path, number: int) -> bool:
    """Return whether a line names the columns; raises `ReferenceFormatError` when it names y before x."""
    words = line.split() if separator == _SPACES else line.split(separator)
    names = [word.strip(" \"'#").lower() for word in words]
    if len(names) < 3 or any(not math.isnan(_number(word, separator)) for word in words):
        return False
    order = [axis for name in names for start, axis in _ORDERS.items() if name.startswith(start)]
    if order[:2] == [1, 0]:
        raise ReferenceFormatError(
            f"{path}, line {number}: latitude or northing comes before longitude or easting; the columns must be "
            f"{COLUMNS}"
        )
    return order[:2] == [0, 1]
