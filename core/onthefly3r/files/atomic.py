"""Files appear under their final name complete or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path, companions: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; rename what was written there when the block succeeds.

    Args:
        path: final name; its folder is made.
        companions: suffixes (with the dot) of further files with the same stem, e.g. `.dbf` beside `.shp`; those that
            the block has written are renamed too, before `path` itself.

    When the block fails, the temporary files are removed and what was at the final names stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    suffixes = [*companions, path.suffix]
    try:
        yield temporary
        for suffix in suffixes:
            if temporary.with_suffix(suffix).exists():
                temporary.with_suffix(suffix).replace(path.with_suffix(suffix))
    finally:
        for suffix in suffixes:
            temporary.with_suffix(suffix).unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text with line feeds atomically; undecodable file names become \\udcxx escapes (valid in JSON)."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")
