"""README's table of platforms is what the package index says."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def platforms() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "platforms.py"))


def readme_table() -> list[str]:
    lines = [line.strip() for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()]
    first = next(number for number, line in enumerate(lines) if line.startswith("| system |"))
    return lines[first : lines.index("", first)]


def test_readme_names_every_promised_system_and_python(platforms: dict[str, Any]) -> None:
    head, _, *rows = readme_table()
    assert [cell.strip() for cell in head.strip("|").split("|")[1:]] == [f"Python {p}" for p in platforms["PYTHONS"]]
    assert [row.split("|")[1].strip() for row in rows] == list(platforms["SYSTEMS"])


@pytest.mark.network
@pytest.mark.slow
def test_readme_promises_no_build_that_the_index_lacks(platforms: dict[str, Any]) -> None:
    try:
        found = platforms["table"]()
    except Exception as error:
        if type(error).__name__ != "IndexUnreachableError":
            raise
        pytest.skip(f"no package index to ask: {str(error)[:200]}")
    for promised, row in zip(readme_table(), found.splitlines(), strict=True):
        for said, is_so in zip(promised.split("|"), row.split("|"), strict=True):
            assert said.strip() == is_so.strip() or not said.strip().startswith("yes"), f"{promised}: {is_so}"
