"""Pack the QGIS plugin into a zip that the plugin repository takes. Standard library only.

    python3 tools/package_plugin.py [--publish]

With --publish, the zip is one to hand in: it is refused while publisher.cfg still has examples in it.
"""

from __future__ import annotations

import configparser
import re
import sys
import zipfile
from pathlib import Path
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parents[1]
NAME = "onthefly3r_qgis"  # not that of the core's package: both may be imported by one interpreter
MAX_BYTES = 25_000_000
DATE = (2024, 1, 1, 0, 0, 0)  # of every entry: the same source gives the same zip

FILES = ("__init__.py", "metadata.txt", "LICENSE", "README.md", "CHANGELOG.md", "bootstrap.py", "pyproject.toml")
FOLDERS = ("core/onthefly3r", "plugin", "processing_algorithms", "resources", "docs")
SUFFIXES = {".py", ".typed", ".txt", ".md", ".svg", ".qml", ".csv", ".gz", ".png"}


# Of RFC 2606: nobody can be reached there.
EXAMPLE_HOST = re.compile(r"(?:.*\.)?(?:example(?:\.(?:com|net|org))?|test|invalid|localhost)", re.IGNORECASE)
ADDRESSES = ("author", "email", "homepage", "repository", "tracker")


def package(out: Path | None = None, publish: bool = False, root: Path = ROOT) -> Path:
    """Write `dist/onthefly3r_qgis-<version>.zip` or `out` and return its path.

    Raises `ValueError` when the zip is too big, or an address cannot be published.
    """
    addresses = publisher(root / "publisher.cfg")
    if publish:
        require_published(addresses)
    version = plugin_version()
    out = out or ROOT / "dist" / f"{NAME}-{version}.zip"
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.part")
    with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for path in contents():
            entry = zipfile.ZipInfo(f"{NAME}/{path.relative_to(ROOT).as_posix()}", DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o100644 << 16  # a plain file, readable, not executable
            content = metadata(path, addresses) if path == ROOT / "metadata.txt" else path.read_bytes()
            archive.writestr(entry, content)
    size = temporary.stat().st_size
    if size > MAX_BYTES:
        temporary.unlink()
        raise ValueError(f"the zip has {size:,} bytes; the plugin repository takes {MAX_BYTES:,}")
    temporary.replace(out)
    return out


def publisher(path: Path) -> dict[str, str]:
    """Return author and addresses; raises `ValueError` when one is missing."""
    parser = configparser.ConfigParser(interpolation=None)
    parser.read(path, encoding="utf-8")
    told = {name: parser.get("publisher", name, fallback="").strip() for name in ADDRESSES}
    missing = [name for name, value in told.items() if not value]
    if missing:
        raise ValueError(f"{path.name} lacks {', '.join(missing)}")
    return told


def require_published(addresses: dict[str, str]) -> None:
    """Raise `ValueError` where an address is an example, or none that the plugin repository takes."""
    wrong = [f"{name} = {value}" for name, value in addresses.items() if EXAMPLE_HOST.fullmatch(_host(value))]
    wrong += [
        f"{name} = {value}"
        for name, value in addresses.items()
        if name in ("homepage", "repository", "tracker") and not re.match(r"https?://[^/\s]+\.[^/\s]+", value)
    ]
    if not re.fullmatch(r"[^@\s]+@[^@\s]+\.[^@\s]+", addresses["email"]):
        wrong.append(f"email = {addresses['email']}")
    if wrong:
        told = "\n  ".join(dict.fromkeys(wrong))
        raise ValueError(f"publisher.cfg has addresses that nobody can be reached at; fill in your own:\n  {told}")


def _host(address: str) -> str:
    """Return the computer that an address names, empty where it names none."""
    return address.rpartition("@")[2] if "@" in address else urlsplit(address).hostname or ""


def metadata(path: Path, addresses: dict[str, str]) -> bytes:
    """Return metadata.txt with the publisher's addresses and the packages that the environment gets."""
    text = path.read_text(encoding="utf-8").replace("@dependencies@", ", ".join(dependencies()))
    lines = "".join(f"{name}={value}\n" for name, value in addresses.items())
    return text.replace("license=", f"{lines}license=", 1).encode("utf-8")


def dependencies() -> list[str]:
    """Return the names of the packages that the base installation needs."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.search(r"^dependencies = \[(.*?)^\]", text, flags=re.MULTILINE | re.DOTALL)
    if listed is None:
        raise ValueError("pyproject.toml lists no dependencies")
    return re.findall(r'^\s*"([\w-]+)', listed.group(1), flags=re.MULTILINE)


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
    try:
        print(package(publish="--publish" in sys.argv[1:]))
    except ValueError as error:
        sys.exit(str(error))
