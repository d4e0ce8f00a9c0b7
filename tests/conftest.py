"""Fixtures that several test files share."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType

import pytest

from onthefly3r.commands.doctor import PACKAGES, check_package

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def photograph_sets() -> Path:
    """Folder of real photograph sets: photos/, reference/ and perhaps gcp_list.txt in a sub-folder for each set."""
    named = os.environ.get("ONTHEFLY3R_PHOTOGRAPHS")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if not any(folder.glob("*/photos")):
        pytest.skip(
            f"no real photographs in {folder}: name a folder of sets (SET/photos, SET/reference) "
            "in the variable ONTHEFLY3R_PHOTOGRAPHS"
        )
    return folder


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """The package open3d, tried in another process first; without its system libraries the test is left out."""
    check = check_package(next(package for package in PACKAGES if package.module == "open3d"))
    if check.status != "ok":
        pytest.skip(f"open3d: {check.found}; {check.remedy}")
    import open3d

    return open3d
