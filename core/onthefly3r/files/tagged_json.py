"""Values of a few known classes as JSON and back, exactly: arrays, sets, tuples and dataclasses are tagged.

Only classes that the reader names are made: a file from elsewhere can do no more than hold wrong values.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

TAG = "@"
LONG = 8  # whole numbers in a row that are worth shortening
_DTYPES = ("float64", "float32", "int64", "int32", "uint8", "bool")


def to_tagged(value: Any) -> Any:
    """Return a value as JSON; raises `TypeError` for what has no form there."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        return {TAG: "array", "dtype": str(value.dtype), "shape": list(value.shape), "values": value.ravel().tolist()}
    if isinstance(value, list | tuple | set | frozenset):
        kind = type(value).__name__
        items = sorted(value) if isinstance(value, set | frozenset) else list(value)
        if len(items) >= LONG and all(type(item) is int for item in items):
            return {TAG: kind, "runs": _runs(items)}
        told = [to_tagged(item) for item in items]
        return told if kind == "list" else {TAG: kind, "items": told}
    if isinstance(value, Mapping):
        return {TAG: "dict", "items": [[to_tagged(key), to_tagged(item)] for key, item in value.items()]}
    if is_dataclass(value):
        return {TAG: type(value).__name__} | {f.name: to_tagged(getattr(value, f.name)) for f in fields(value)}
    raise TypeError(f"{type(value).__name__} cannot be written")


def from_tagged(told: Any, classes: Iterable[type]) -> Any:
    """Return the value that `to_tagged` wrote; raises `ValueError`, `KeyError` or `TypeError` for anything else."""
    known = {cls.__name__: cls for cls in classes}

    def value_of(told: Any) -> Any:
        if isinstance(told, list):
            return [value_of(item) for item in told]
        if not isinstance(told, dict):
            return told
        told = dict(told)
        tag = told.pop(TAG)
        if tag == "array":
            if told["dtype"] not in _DTYPES:
                raise ValueError(f"array of {told['dtype']!r}")
            return np.array(told["values"], told["dtype"]).reshape([int(n) for n in told["shape"]])
        if tag == "dict":
            return {value_of(key): value_of(item) for key, item in told["items"]}
        if tag in _SEQUENCES:
            items = _unrolled(told["runs"]) if "runs" in told else [value_of(item) for item in told["items"]]
            return _SEQUENCES[tag](items)
        return known[tag](**{name: value_of(item) for name, item in told.items()})

    return value_of(told)


_SEQUENCES: Mapping[str, Any] = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}


def _runs(numbers: list[int]) -> list[int]:
    """Return first and length of each run of rising numbers, one after another."""
    found: list[int] = []
    for number in numbers:
        if found and number == found[-2] + found[-1]:
            found[-1] += 1
        else:
            found += [number, 1]
    return found


def _unrolled(runs: list[int]) -> list[int]:
    if sum(runs[1::2]) > 10_000_000:
        raise ValueError("too many numbers")
    return [
        number for first, count in zip(runs[::2], runs[1::2], strict=True) for number in range(first, first + count)
    ]
