"""How one option is declared: its default, help, unit, bounds and example, and the check of its values.

Standard library only: QGIS imports this module in its own process.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import field
from typing import Any

from .errors import OptionError


def option(
    default: Any,
    help: str,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
    minimum: float | None = None,
    maximum: float | None = None,
    advanced: bool = False,
    example: str = "",
) -> Any:
    """Declare one option: help, unit, bounds and example appear in every user interface, and values are checked."""
    metadata = {
        "example": example,
        "help": help,
        "unit": unit,
        "choices": choices,
        "minimum": minimum,
        "maximum": maximum,
        "advanced": advanced,
    }
    return field(default=default, metadata=metadata)


class CheckedOptions:
    """Base of option slices: an object with a wrong value cannot be made, whoever makes it."""

    def __post_init__(self) -> None:
        """Check every field against its type and bounds; raises `OptionError`."""
        for item in dataclasses.fields(self):  # type: ignore[arg-type]
            if "help" in item.metadata:
                _check(item, getattr(self, item.name))


def allowed_types(item: dataclasses.Field[Any]) -> tuple[str, ...]:
    """Return the names of the types that an option takes, as in its annotation: `int`, `float`, `bool`, `str`, `None`.

    Annotations are read as text: the Python of the oldest QGIS cannot evaluate `float | None`.
    """
    return tuple(str(item.type).split(" | "))


def _check(item: dataclasses.Field[Any], value: Any) -> None:
    name, allowed = item.name, allowed_types(item)
    if value is None:
        if "None" not in allowed:
            raise OptionError(f"{name}: this option requires a value")
        return
    if item.metadata["choices"]:
        if value not in item.metadata["choices"]:
            raise OptionError(f"{name}: {value!r} is not one of {', '.join(item.metadata['choices'])}")
        return
    numeric_float = "float" in allowed and isinstance(value, (int, float)) and not isinstance(value, bool)
    if not numeric_float and type(value).__name__ not in allowed:
        raise OptionError(f"{name}: {value!r} is not a {' or '.join(allowed)}")
    if isinstance(value, float) and not math.isfinite(value):
        raise OptionError(f"{name}: {value} is not a finite number")
    low, high = item.metadata["minimum"], item.metadata["maximum"]
    unit = f" {item.metadata['unit']}" if item.metadata["unit"] else ""
    if low is not None and not value >= low:
        raise OptionError(f"{name}: {value} is below the minimum of {low}{unit}")
    if high is not None and not value <= high:
        raise OptionError(f"{name}: {value} is above the maximum of {high}{unit}")
