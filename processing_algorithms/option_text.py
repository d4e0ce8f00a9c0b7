"""Further options as text: `name=value`, as on the command line, for all that has no parameter of its own."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ..core.onthefly3r.errors import OptionError
from ..core.onthefly3r.option_fields import allowed_types
from ..core.onthefly3r.options import Options, iterate_options

MAX_PRESET_BYTES = 64 * 1024
_COMMENT = re.compile(r"^\s*#.*$", re.MULTILINE)
_NAME = re.compile(r"(?:^|(?<=[\s;,]))(?:--)?([A-Za-z][\w-]*)\s*=")
TRUTHS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def read_options(text: str) -> dict[str, Any]:
    """Return the options that a text names, or the file that it is the path of; raises `OptionError`.

    Options stand on lines of their own or are separated by blanks, commas or semicolons; a line that begins with # is
    a comment. Names are those of the command line, values are checked.
    """
    text = text.strip()
    if text and "\n" not in text and ("=" not in text or Path(text.strip("\"'")).is_file()):
        text = _preset(text)
    text = _COMMENT.sub("", text).strip()
    found = list(_NAME.finditer(text))
    before = text[: found[0].start()] if found else text
    if before.strip():
        raise OptionError(f"{before.strip()!r} is not an option: write name=value, for instance threads=2")
    ends = [match.start() for match in found[1:]] + [len(text)]
    options: dict[str, Any] = {}
    for match, end in zip(found, ends):  # noqa: B905 - Python 3.9 of QGIS
        name = known_name(match.group(1))
        if name in options:
            raise OptionError(f"{name} is named twice")
        options[name] = _value(name, text[match.end() : end].strip(" \t\r\n;,").strip("\"'"))
    Options.from_flat(options)
    return options


def known_name(name: str) -> str:
    """Return the option that a name means, whatever its case and its hyphens; raises `OptionError` with the nearest."""
    plain = name.lower().replace("-", "_")
    known = ["preset", *_fields()]
    if plain in known:
        return plain
    near = get_close_matches(plain, known, 3, 0.6)
    meant = f"did you mean {' or '.join(near)}? " if near else ""
    raise OptionError(f"{name} is no option; {meant}Known options: {', '.join(sorted(known))}")


def _fields() -> Mapping[str, dataclasses.Field]:
    return {item.name: item for _, item in iterate_options()}


def _value(name: str, text: str) -> Any:
    """Return a value in the type that the option has; what is none of that type is left to the check of the option."""
    if name == "preset" or not text:
        return text or None
    kinds = allowed_types(_fields()[name])
    if "bool" in kinds:
        return TRUTHS.get(text.lower(), text)
    for word, kind in (("int", int), ("float", float)):
        if word in kinds:
            try:
                return kind(text)
            except ValueError:
                raise OptionError(f"{name}: {text!r} is no {'whole number' if word == 'int' else 'number'}") from None
    return text


def _preset(text: str) -> str:
    path = Path(text.strip("\"'"))
    if not path.is_file():
        raise OptionError(f"{text!r} is neither name=value nor a file of such lines")
    try:
        if path.stat().st_size > MAX_PRESET_BYTES:
            raise OptionError(f"{path}: larger than {MAX_PRESET_BYTES // 1024} KiB and no file of options")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"{path} cannot be read ({error}); options are a text file in UTF-8") from error
