"""Plain mutation of sound files: the same seed gives the same inputs on every machine."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence

MOST_CHANGES = 4
MOST_BYTES = 1 << 20
BYTES = (0, 1, 0x7F, 0x80, 0xFE, 0xFF)
WORDS = (0, 1, 2, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
NUMBERS = (
    b"0", b"-1", b"nan", b"inf", b"-inf", b"1e300", b"1e-300", b"1/0", b"65535", b"4294967295", b"9" * 400, b"0x10",
    b"1,5", b"--3", b"",
)  # fmt: skip
TEXTS = (
    b"\0",
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    b"\n",
    b"\r",
    b"\t",
    b";",
    b",",
    b'"',
    b"'",
    b"<",
    b">",
    b"&",
    b"#",
    b"%s",
)
_DIGITS = re.compile(rb"[+-]?\d+(?:\.\d+)?")


def mutated(seeds: Sequence[bytes], rng: random.Random) -> bytes:
    """Return one of the seeds with a few changes: bytes, words, numbers in text, pieces moved, doubled or cut."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, MOST_CHANGES)):
        if not data:
            data = bytearray(rng.choice(TEXTS))
        at = rng.randrange(len(data))
        if rng.random() < 0.6:  # most of what decides is at the start
            at = min(at, rng.randrange(1, 1 + min(len(data), 600)) - 1)
        _change(data, at, seeds, rng)
    return bytes(data[:MOST_BYTES])


def _change(data: bytearray, at: int, seeds: Sequence[bytes], rng: random.Random) -> None:
    kind = rng.randrange(10)
    if kind == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        data[at] = rng.choice(BYTES)
    elif kind == 2:
        size = rng.choice((2, 4))
        word = rng.choice(WORDS) & ((1 << 8 * size) - 1)
        data[at : at + size] = word.to_bytes(size, rng.choice(("little", "big")))
    elif kind == 3:
        del data[at:]
    elif kind == 4:
        del data[at : at + rng.randint(1, 64)]
    elif kind == 5:
        data[at:at] = rng.choice(TEXTS) * rng.choice((1, 1, 2, 50))
    elif kind == 6:
        piece = bytes(data[at : at + rng.randint(1, 200)])
        data[at:at] = piece * rng.choice((1, 2, 20))
    elif kind == 7:
        other = rng.choice(seeds)
        start = rng.randrange(len(other)) if other else 0
        data[at : at + rng.randint(0, 100)] = other[start : start + rng.randint(1, 200)]
    else:
        number = _DIGITS.search(data, at)
        if number:
            data[number.start() : number.end()] = rng.choice(NUMBERS)
        else:
            data[at] = rng.randrange(256)
