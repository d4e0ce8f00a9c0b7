"""What was made of the pixels of photographs for retrieval, kept on disk for a run that goes on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.array_file import ArrayFile
from ..geometry.arrays import Float, UInt8


class DescribedImages:
    """Descriptors and small pictures by shot index, and what the descriptor learnt.

    All of it can be made again from the photographs: what a power cut took or damaged is not there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def keep(self, index: int, descriptor: Float, small: UInt8) -> None:
        """Keep descriptor and small picture of one image."""
        self._write(f"{index:06d}.seen.npz", {"descriptor": descriptor, "small": small})

    def load(self, index: int) -> tuple[Float, UInt8] | None:
        """Return what `keep` kept of an image, None where it is not there any more."""
        found = self._read(f"{index:06d}.seen.npz")
        return (
            None if found is None or found.keys() != {"descriptor", "small"} else (found["descriptor"], found["small"])
        )

    def keep_learnt(self, learnt: Mapping[str, Float]) -> None:
        """Keep what the descriptor learnt."""
        self._write("learnt.npz", learnt)

    def load_learnt(self) -> dict[str, Any] | None:
        """Return what `keep_learnt` kept, None where it is not there any more."""
        return self._read("learnt.npz")

    def _write(self, name: str, arrays: Mapping[str, Any]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        temporary = self._folder / "000000.part.npz"
        np.savez(temporary, **arrays)
        temporary.replace(self._folder / name)

    def _read(self, name: str) -> dict[str, Any] | None:
        path = self._folder / name
        if not path.exists():
            return None
        try:
            with ArrayFile(path) as stored:
                return {name: stored[name] for name in stored.names()}
        except InputError:
            return None
