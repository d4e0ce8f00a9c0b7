"""Whether a folder can be written, and whether the disk has the room: told before the work where it can be."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from ..errors import StorageError

# Failures of the disk or of permissions: the user can mend them, a traceback would not help.
_NO_ROOM = {errno.ENOSPC, errno.EFBIG, *([errno.EDQUOT] if hasattr(errno, "EDQUOT") else [])}
_NO_ACCESS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.EIO, errno.ENXIO, errno.ENODEV}
MIB = 2**20


def require_access(folder: Path) -> None:
    """Raise `StorageError` unless files can be made in a folder, or the folder in the one above it."""
    place = _there(folder)
    if not place.is_dir():
        raise StorageError(f"{place}: is a file, so that {folder} cannot be made; name another folder")
    if not os.access(place, os.W_OK | os.X_OK):
        raise StorageError(f"{place}: cannot be written in (no permission, or a read-only disk); name another folder")


def require_room(folder: Path, need_bytes: int, what: str) -> None:
    """Raise `StorageError` unless the disk of a folder has so many bytes free."""
    with contextlib.suppress(OSError):  # a disk that does not tell is tried
        free = shutil.disk_usage(_there(folder)).free
        if free < need_bytes:
            raise StorageError(
                f"{folder}: the disk has {free / MIB:.0f} MiB free, and {what} needs about {need_bytes / MIB:.0f} MiB; "
                "make room, or name a folder on another disk"
            )


def is_storage_trouble(error: OSError) -> bool:
    """Return whether an error is one of the disk or of permissions."""
    return error.errno in _NO_ROOM | _NO_ACCESS


def storage_error(error: OSError, folder: Path | None) -> StorageError:
    """Return the error with a reason that a user can act on."""
    place = error.filename or folder
    reason = error.strerror or type(error).__name__
    if error.errno in _NO_ROOM:
        return StorageError(f"no room left on the disk ({reason}): {place}; make room and run the command again")
    return StorageError(f"no access ({reason}): {place}; what was there before is as it was")


@contextlib.contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Raise `StorageError` for what goes wrong with the disk of `folder` in the block."""
    try:
        yield
    except OSError as error:
        if not is_storage_trouble(error):
            raise
        raise storage_error(error, folder) from error


def _there(folder: Path) -> Path:
    """Return the folder, or the nearest one above it that exists."""
    place = Path(os.path.abspath(folder))  # noqa: PTH100 - links in it stay as they are
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    return place
