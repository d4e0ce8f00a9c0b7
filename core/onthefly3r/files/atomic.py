"""Files appear under their final name complete or not at all, and survive a power cut once they are there."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

WINDOWS = os.name == "nt"
LOCKED_WAITS_S = (0.05, 0.1, 0.2, 0.4, 0.8, 1.5)
_NO_FOLDER_SYNC = (errno.EINVAL, errno.EBADF, errno.ENOTSUP, errno.EACCES)  # on some network drives


@contextmanager
def replacing(path: Path, companions: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; rename what was written there when the block succeeds.

    Args:
        path: final name; its folder is made.
        companions: suffixes (with the dot) of further files with the same stem, e.g. `.dbf` beside `.shp`; those that
            the block has written are renamed too, before `path` itself.

    The temporary name is random and was not there before. Files are synced before they are renamed, and the folder
    after. When the block fails, the temporary files are removed and what was at the final names stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".onthefly3r-{secrets.token_hex(8)}.part{path.suffix}")
    suffixes = [*companions, path.suffix]
    create_exclusively(temporary)
    try:
        yield temporary
        written = [suffix for suffix in suffixes if temporary.with_suffix(suffix).exists()]
        for suffix in written:
            sync_file(temporary.with_suffix(suffix))
        for suffix in written:
            replace_file(temporary.with_suffix(suffix), path.with_suffix(suffix))
        sync_folder(path.parent)
    finally:
        for suffix in suffixes:
            with contextlib.suppress(OSError):  # what ended the block is to be heard, not this
                temporary.with_suffix(suffix).unlink(missing_ok=True)


def replace_file(source: Path, target: Path) -> None:
    """Rename a file over whatever has its final name.

    Windows refuses that while another program has the file open, as virus scanners, indexers and previews do for a
    moment: it is tried again for three seconds. Raises `OSError` when it cannot be done.
    """
    for wait_s in LOCKED_WAITS_S if WINDOWS else ():
        try:
            source.replace(target)
            return
        except PermissionError:
            time.sleep(wait_s)
    source.replace(target)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text with line feeds atomically; undecodable file names become \\udcxx escapes (valid in JSON)."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


def create_exclusively(path: Path) -> None:
    """Create an empty file; raises `FileExistsError` when anything has that name, a link to nowhere too."""
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0), 0o666))


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk."""
    # Windows syncs only what is open for writing.
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        _sync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk; Windows has no such call, and writes them in order."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        _sync(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def _sync(descriptor: int) -> None:
    if sys.platform == "darwin":  # where fsync leaves the data in the drive's own memory
        import fcntl

        with contextlib.suppress(OSError):
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
            return
    os.fsync(descriptor)
