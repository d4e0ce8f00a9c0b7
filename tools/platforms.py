"""Resolve the base installation for every promised system and Python, and print README's table of platforms.

    .venv/bin/python tools/platforms.py

Asks the package index that uv is set up with; nothing is downloaded but metadata. What a requirement requires in turn
is resolved too.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
SYSTEMS = {
    "Windows x86_64": "x86_64-pc-windows-msvc",
    "macOS arm64": "aarch64-apple-darwin",
    "macOS x86_64": "x86_64-apple-darwin",
    "Linux x86_64": "x86_64-manylinux_2_28",
    "Linux aarch64": "aarch64-manylinux_2_28",
}
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
OPTIONAL = "gtsam"  # required only where it has a build
NO_WHEELS = r"(?:Because|and|that) ([\w.-]+?)(?:[<>=!~][^ ]*)? (?:has|have) no wheels"
WHEELS_ELSEWHERE = r"Wheels are available for `([\w.-]+)`"
OLDEST_MACOS = "14.0"
UNREACHABLE = ("error sending request", "Failed to fetch", "dns error", "Network unreachable")


class IndexUnreachableError(Exception):
    """The package index does not answer, or uv is missing."""


def requirements() -> list[str]:
    """Return what the base installation requires, as pyproject.toml says it."""
    return list(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"])


def found_on(system: str, python: str) -> str:
    """Return a cell of the table: `yes`, what is left out there, or what has no build."""
    wanted, missing = requirements(), []
    while True:
        solved, told = _resolve(wanted, SYSTEMS[system], python)
        if solved:
            break
        if any(sign in told for sign in UNREACHABLE):
            raise IndexUnreachableError(told)
        lacking = re.search(
            r"(?:Because|and|that) ([\w.-]+?)(?:[<>=!~][^ ]*)? (?:has|have) no wheels", " ".join(told.split())
        )
        lacking = lacking or re.search(r"Wheels are available for `([\w.-]+)`", told)
        if lacking is None:
            return f"no ({told.strip().splitlines()[-1]})"
        missing.append(lacking.group(1))
        left = [line for line in wanted if not line.startswith(missing[-1])]
        if left == wanted:  # it is required by one of ours
            return f"no {', '.join(missing)}"
        wanted = left
    if missing:
        return ", ".join(f"no {name}" for name in missing)
    return "yes" if re.search(rf"^{OPTIONAL}==", told, re.MULTILINE) else f"yes, without {OPTIONAL}"


def _resolve(wanted: list[str], platform: str, python: str) -> tuple[bool, str]:
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "requirements.in"
        file.write_text("\n".join(wanted), encoding="utf-8")
        try:
            command = [sys.executable, "-m", "uv", "pip", "compile", file, "--only-binary", ":all:", "--no-header"]
            choices = ["--no-config", "--color", "never", "--python-platform", platform, "--python-version", python]
            ran = subprocess.run(
                [*command, *choices],
                capture_output=True,
                text=True,
                timeout=300,
                check=False,
                env={**os.environ, "UV_PYTHON_DOWNLOADS": "never", "MACOSX_DEPLOYMENT_TARGET": OLDEST_MACOS},
            )
        except subprocess.TimeoutExpired as error:
            raise IndexUnreachableError("the package index did not answer in time") from error
    if "No module named uv" in ran.stderr:
        raise IndexUnreachableError("uv is not installed")
    return ran.returncode == 0, ran.stdout if ran.returncode == 0 else ran.stderr


def table() -> str:
    """Return README's table."""
    cells = [(system, python) for system in SYSTEMS for python in PYTHONS]
    with ThreadPoolExecutor(4) as pool:
        found = dict(zip(cells, pool.map(lambda cell: found_on(*cell), cells), strict=True))
    lines = [
        "| system | " + " | ".join(f"Python {python}" for python in PYTHONS) + " |",
        "|---|" + "---|" * len(PYTHONS),
    ]
    for system in SYSTEMS:
        lines.append(f"| {system} | " + " | ".join(found[system, python] for python in PYTHONS) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
