"""Write docs/options.md from the option declarations: `make docs`."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

HEAD = """# Options

Made by `make docs` from `core/onthefly3r/options.py`; the command line, Python and the table below have the same
names, defaults, units and bounds. On the command line a name has dashes (`--seed-size 20`), in Python underscores
(`Options.from_flat({"seed_size": 20})`). Switches are `--name` and `--no-name`.

`--preset paper` takes the defaults of the paper where ours differ; options that are named still win.
"""


def page() -> str:
    """Return the whole page."""
    sys.path.insert(0, str(ROOT / "core"))
    from onthefly3r.options import PAPER_NOTES, PAPER_VALUES, slice_classes

    parts = [HEAD]
    for name, options_class in slice_classes().items():
        parts.append(f"## {name.replace('_', ' ').capitalize()}\n")
        parts.append(str(options_class.__doc__).strip() + "\n")
        parts.append("| option | default | unit | allowed | example | what it does |\n|---|---|---|---|---|---|")
        parts += [row(item) for item in dataclasses.fields(options_class)]
        parts.append("")
    parts.append("## What the preset `paper` changes\n")
    parts += [f"- `--{name.replace('_', '-')}`: {shown(value)}" for name, value in PAPER_VALUES.items()]
    parts.append("\nWhat it does not say by itself:\n")
    parts += [f"- {note}" for note in PAPER_NOTES]
    return "\n".join(parts) + "\n"


def row(item: dataclasses.Field[Any]) -> str:
    """Return one line of a table."""
    facts = item.metadata
    low, high = facts["minimum"], facts["maximum"]
    bounds = [f"≥ {low}"] if low is not None else []
    bounds += [f"≤ {high}"] if high is not None else []
    allowed = ", ".join(facts["choices"] or bounds)
    meaning = facts["help"] + (" *(advanced)*" if facts["advanced"] else "")
    cells = (f"`--{item.name.replace('_', '-')}`", shown(item.default), facts["unit"], allowed, example(item), meaning)
    return "| " + " | ".join(cells) + " |"


def example(item: dataclasses.Field[Any]) -> str:
    """Return how the option is written with a value that is not the default."""
    flag, facts, default = "--" + item.name.replace("_", "-"), item.metadata, item.default
    if isinstance(default, bool):
        return f"`--no-{flag[2:]}`" if default else f"`{flag}`"
    value = facts["example"] or next((choice for choice in facts["choices"] if choice != default), "")
    if not value and isinstance(default, int | float):
        value = str(min(default * 2, facts["maximum"] or default * 2) or 1)
    return f"`{flag} {value}`"


def shown(value: object) -> str:
    """Return a value as a reader expects it."""
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else "" if value is None else f"{value}"


if __name__ == "__main__":
    (ROOT / "docs" / "options.md").write_text(page(), encoding="utf-8", newline="\n")
