"""Named arrays in one file (numpy's .npz, not compressed), read without believing the sizes that it states."""

from __future__ import annotations

import zipfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..errors import InputError


class ArrayFile:
    """The arrays of a file that `numpy.savez` wrote, each read when it is asked for.

    A file from elsewhere cannot make the reader allocate more than its own size: compressed members, arrays larger
    than their member, and pickled objects are refused.

    Raises:
        InputError: the file is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile) as error:
            raise self._damaged(error) from None

    def __enter__(self) -> ArrayFile:
        """Return the open file."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close it."""
        self._zip.close()

    def __contains__(self, name: str) -> bool:
        """Return whether there is an array of this name."""
        return f"{name}.npy" in self._zip.NameToInfo

    def names(self) -> list[str]:
        """Return the names of all arrays."""
        return [name.removesuffix(".npy") for name in self._zip.NameToInfo if name.endswith(".npy")]

    def __getitem__(self, name: str) -> np.ndarray[Any, Any]:
        """Return one array."""
        try:
            member = self._zip.getinfo(f"{name}.npy")
            if member.compress_type != zipfile.ZIP_STORED or member.file_size > self._path.stat().st_size:
                raise ValueError(f"{name} is compressed, or larger than the file")
            with self._zip.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                if version != (1, 0):
                    raise ValueError(f"{name} is of format {version}")
                shape, column_major, kind = np.lib.format.read_array_header_1_0(stream)
                if kind.hasobject:
                    raise ValueError(f"{name} holds objects instead of numbers")
                data = stream.read()
            array = np.frombuffer(bytearray(data), kind)  # a copy, so that it can be written to
            if array.size != int(np.prod(shape, dtype=object)):
                raise ValueError(f"{name} has {array.size} values instead of those of the shape {shape}")
            return array.reshape(shape, order="F" if column_major else "C")
        except MemoryError:
            raise
        except Exception as error:  # zip and header, which is a Python literal, know many ways to be damaged
            raise self._damaged(error) from None

    def _damaged(self, error: Exception) -> InputError:
        return InputError(f"{self._path} is missing or damaged ({error}); run again")
