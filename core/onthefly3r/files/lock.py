"""A lock on a folder that names who holds it; the operating system frees it when that process ends, however it ends."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import sys
import time
from pathlib import Path
from typing import Any

from ..errors import BusyError, InputError
from .strict_json import loads

LOCK_NAME = "onthefly3r.lock"
MAX_LOCK_BYTES = 4096
ATTEMPTS = 20
_UNSUPPORTED = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}
_LOCKED_BYTE = 2**30  # far behind the text: Windows lets nobody read the bytes that are locked


class FolderLock:
    """One process at a time works in a folder; a second one is told at once who the first is."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOCK_NAME
        self._descriptor: int | None = None

    def acquire(self, doing: str) -> None:
        """Take the lock for a verb; the lock of a process that has ended is taken over.

        Raises:
            BusyError: another process holds it, or a process on another computer may hold it.
            InputError: the name of the lock is taken by something else.
        """
        for _ in range(ATTEMPTS):
            descriptor = self._open()
            try:
                supported = _try_lock(descriptor)
                if supported is None:
                    raise BusyError(self._told(_holder(descriptor), "is in use"))
                if _same_file(descriptor, self.path):
                    self._take(descriptor, doing, supported)
                    self._descriptor = descriptor
                    return
            finally:
                if self._descriptor != descriptor:
                    os.close(descriptor)
        raise BusyError(f"{self.path.parent}: is in use by another process; wait for it to end")

    def release(self) -> None:
        """Give the lock back and remove its file; no harm where it is not held."""
        if self._descriptor is None:
            return
        descriptor, self._descriptor = self._descriptor, None
        if os.name != "nt":  # removed while it is held: nobody else can have taken it
            with contextlib.suppress(OSError):
                self.path.unlink()
        os.close(descriptor)
        if os.name == "nt":
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        try:
            return os.open(self.path, flags, 0o666)
        except OSError as error:
            if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
                raise InputError(f"{self.path}: is no lock of ours; remove it or name another folder") from error
            raise

    def _take(self, descriptor: int, doing: str, supported: bool) -> None:
        holder = _holder(descriptor)
        if holder is None:
            raise InputError(f"{self.path}: is no lock of ours; remove it or name another folder")
        here = socket.gethostname()
        if holder:
            if holder.get("host") != here:
                raise BusyError(self._told(holder, "seems to be in use"))
            if not supported and _is_alive(int(holder.get("pid", 0))):
                raise BusyError(self._told(holder, "is in use"))
        text = json.dumps(
            {"pid": os.getpid(), "host": here, "verb": doing, "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        )
        os.ftruncate(descriptor, 0)
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, text.encode())

    def _told(self, holder: dict[str, Any] | None, state: str) -> str:
        who = "another process"
        if holder:
            who = f"process {holder.get('pid')} on {holder.get('host')} ({holder.get('verb')}, {holder.get('since')})"
        remedy = "wait for it to end, or name another folder"
        if holder and holder.get("host") != socket.gethostname():
            remedy += f"; if that process has ended, delete {self.path}"
        return f"{self.path.parent}: {state} by {who}; {remedy}"


def _holder(descriptor: int) -> dict[str, Any] | None:
    """Return what the lock says, empty where it says nothing yet, None where it is not ours."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    try:
        text = os.read(descriptor, MAX_LOCK_BYTES)
        if not text:
            return {}
        told = loads(text)
    except (OSError, ValueError):
        return None
    return told if isinstance(told, dict) and isinstance(told.get("pid"), int) and "host" in told else None


def _try_lock(descriptor: int) -> bool | None:
    """Lock a file; None when another process has it, False where the file system knows no locks."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK):
            return None
        if error.errno in _UNSUPPORTED:
            return False
        raise
    return True


def _same_file(descriptor: int, path: Path) -> bool:
    """Return whether the open file still has its name: its last holder removes it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _is_alive(pid: int) -> bool:
    if os.name == "nt" or pid <= 0:
        return pid > 0  # Windows knows locks wherever it writes
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
