"""Pack the QGIS plugin into a zip that the plugin repository takes. Standard library only."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NAME = "onthefly3r_qgis"  # not that of the core's package: both may be imported by one interpreter
MAX_BYTES = 25_000_000
DATE = (2024, 1, 1, 0, 0, 0)  # of every entry: the same source gives the same zip

FILES = ("__init__.py", "metadata.txt", "LICENSE", "README.md", "CHANGELOG.md", "bootstrap.py", "pyproject.toml")
FOLDERS = ("core/onthefly3r", "plugin", "processing_algorithms", "resources", "docs")
SUFFIXES = {".py", ".typed", ".txt", ".md", ".svg", ".qml", ".csv", ".gz", ".png"}


def package(out: Path | None = None) -> Path:
    """Write `dist/onthefly3r_qgis-<version>.zip` or `out`, return its path; raises `ValueError` when it is too big."""
    version = plugin_version()
    out = out or ROOT / "dist" / f"{NAME}-{version}.zip"
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.part")
    with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for path in contents():
            entry = zipfile.ZipInfo(f"{NAME}/{path.relative_to(ROOT).as_posix()}", DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o100644 << 16  # a plain file, readable, not executable
            archive.writestr(entry, path.read_bytes())
    size = temporary.stat().st_size
    if size > MAX_BYTES:
        temporary.unlink()
        raise ValueError(f"the zip has {size:,} bytes; the plugin repository takes {MAX_BYTES:,}")
    temporary.replace(out)
    return out


def contents() -> list[Path]:
    """Return what goes into the zip, sorted."""
    found = [ROOT / name for name in FILES]
    for folder in FOLDERS:
        found += [
            path
            for path in (ROOT / folder).rglob("*")
            if path.is_file() and path.suffix in SUFFIXES and not _is_cache(path.relative_to(ROOT))
        ]
    return sorted(found)


def plugin_version() -> str:
    """Return the version of core and plugin; raises `ValueError` when metadata.txt says another."""
    core = _search(r'^__version__ = "(.+)"$', ROOT / "core" / "onthefly3r" / "__init__.py")
    told = _search(r"^version=(.+)$", ROOT / "metadata.txt")
    if core != told:
        raise ValueError(f"metadata.txt has version {told}, the core {core}")
    return core


def _search(pattern: str, path: Path) -> str:
    match = re.search(pattern, path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    if match is None:
        raise ValueError(f"{path.name} has no version")
    return match.group(1)


def _is_cache(path: Path) -> bool:
    return any(part.startswith(".") or part == "__pycache__" or part.endswith(".egg-info") for part in path.parts)


if __name__ == "__main__":
    print(package())
