"""Open files that others made: regular ones only, and never more of them than expected."""

from __future__ import annotations

import errno
import io
import os
import stat
from pathlib import Path


class BoundedReader(io.BufferedReader):
    """A reader that refuses to hand out more bytes, all reads together, than it was allowed."""

    def __init__(self, raw: io.FileIO, limit: int) -> None:
        super().__init__(raw)
        self._left = limit

    def read(self, size: int | None = -1, /) -> bytes:
        """Read as `io.BufferedReader` does; raises `OSError` (EFBIG) beyond the limit."""
        rest = max(0, os.fstat(self.fileno()).st_size - self.tell())
        wanted = rest if size is None or size < 0 else min(size, rest)
        if wanted > self._left:  # before a byte of it is read: a hole of gigabytes costs nothing on the disk
            raise OSError(errno.EFBIG, "more is read from this file than a sound one needs")
        found = super().read(size)
        self._left -= len(found)
        return found

    def allow(self, limit: int) -> None:
        """Let so many more bytes be read from now on."""
        self._left = limit


def open_regular(path: Path, limit: int = 1 << 62) -> BoundedReader:
    """Open a regular file for reading; pipes, sockets and devices are refused instead of waited for.

    Args:
        path: may be a link to a regular file.
        limit: bytes that may be read, all reads together.

    Raises `OSError`; EINVAL for what is no regular file.
    """
    flags = os.O_RDONLY
    for name in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_BINARY"):
        flags |= getattr(os, name, 0)
    descriptor = os.open(path, flags)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        return BoundedReader(io.FileIO(descriptor, "r"), limit)
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file; raises `OSError` (EFBIG) when there are more than `limit`."""
    with open_regular(path, limit) as stream:
        return stream.read()
