"""Windows opens no file whose whole path is longer than 259 characters, unless its owner has allowed that."""

from __future__ import annotations

import os
from pathlib import Path, PurePath

from ..errors import InputError

WINDOWS = os.name == "nt"
MOST_CHARACTERS = 259
# The longest name that is made below an output folder.
LONGEST_NAME = "work/attempt-0123456789abcdef/features/.onthefly3r-0123456789abcdef.part.npz"


def require_short(folder: Path) -> None:
    """Raise `InputError` where the files of an output folder would have longer paths than this Windows opens."""
    if WINDOWS and (told := too_long(folder.absolute(), allows_long_paths())):
        raise InputError(told)


def too_long(folder: PurePath, long_paths_allowed: bool) -> str:
    """Return what to do about an output folder whose files would have too long paths, empty where all is well."""
    spare = MOST_CHARACTERS - len(str(folder)) - 1 - len(LONGEST_NAME)
    if spare >= 0 or long_paths_allowed or str(folder).startswith("\\\\?\\"):
        return ""
    return (
        f"{folder}: the path is {-spare} characters too long for Windows: choose an output folder nearer to the root "
        "of the drive, or have an administrator allow long paths (LongPathsEnabled)"
    )


def allows_long_paths() -> bool:
    """Return whether this Windows opens files with long paths; true on other systems."""
    try:
        import winreg
    except ImportError:
        return True
    try:
        place = r"SYSTEM\CurrentControlSet\Control\FileSystem"
        with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, place) as key:  # type: ignore[attr-defined,unused-ignore]
            return bool(winreg.QueryValueEx(key, "LongPathsEnabled")[0])  # type: ignore[attr-defined,unused-ignore]
    except OSError:
        return False
