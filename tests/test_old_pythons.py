"""Older interpreters: every source compiles for Python 3.10, and what QGIS imports runs on the 3.9 of QGIS 3.22."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = (
    "core",
    "plugin",
    "processing_algorithms",
    "tools",
    "benchmarks",
    "docs",
    "tests",
    "bootstrap.py",
    "__init__.py",
)
# What the plugin imports of the core into QGIS's own process.
LIGHT = """
import sys
sys.path.insert(0, sys.argv[1])
from onthefly3r.errors import OptionError
from onthefly3r.files import atomic, las_index
from onthefly3r.options import Options, iterate_options
from onthefly3r.protocol import Event, Job
assert Options.from_flat({"spacing_m": 1, "limit": None, "crs": "EPSG:32633"}).export.spacing_m == 1
for wrong in ({"threads": 1.5}, {"spacing_m": "x"}, {"working_px": None}, {"recursive": 1}, {"nothing": 1}):
    try:
        Options.from_flat(wrong)
    except OptionError:
        continue
    raise AssertionError(wrong)
extents = [las_index.Extent(3, (0.0,) * 6), las_index.Extent(3, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0))]
assert extents[0].is_same(extents[0]) and not extents[0].is_same(extents[1])
assert Event.from_line(Event("warning", {"message": "m"}).to_line()).data == {"message": "m"}
assert Job("run", ("a",), {"threads": 1}).words() == ["run", "--threads=1", "--json", "--", "a"]
"""


def interpreter(version: str) -> str:
    """A Python of this version: on the path, of pyenv, or this one; else the test is skipped."""
    if sys.version_info[:2] == tuple(map(int, version.split("."))):
        return sys.executable
    root = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    candidates = [*sorted(root.glob(f"{version}.*/bin/python")), shutil.which(f"python{version}")]
    for candidate in filter(None, candidates):
        told = subprocess.run(
            [str(candidate), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], capture_output=True, text=True
        )
        if told.stdout.strip() == version:
            return str(candidate)
    pytest.skip(f"no Python {version} here")


@pytest.mark.slow
def test_all_sources_compile_for_the_oldest_python(tmp_path: Path) -> None:
    python = interpreter("3.10")
    command = [python, "-W", "error", "-m", "compileall", "-q", "-f", *(str(ROOT / name) for name in SOURCES)]
    environ = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path)}
    ran = subprocess.run(command, capture_output=True, text=True, env=environ)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert len(list(tmp_path.rglob("*.pyc"))) > 200


@pytest.mark.parametrize("version", ["3.9", "3.10"])
def test_what_qgis_imports_runs_there(version: str) -> None:
    command = [interpreter(version), "-W", "error", "-B", "-c", LIGHT, str(ROOT / "core")]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
