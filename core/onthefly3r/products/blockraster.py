"""A raster that is filled in any order, in square blocks on disk with the latest ones in memory."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

from ..geometry.arrays import Float

SIDE = 256
MAX_BLOCKS = 64  # in memory


class BlockRaster:
    """Bands of float32 over a grid of blocks that exist once they are touched; a context manager."""

    def __init__(self, path: Path, bands: int, fill: float) -> None:
        """`path` is overwritten; untouched pixels hold `fill`."""
        self._path, self._bands, self._fill = path, bands, fill
        self._cached: OrderedDict[tuple[int, int], Float] = OrderedDict()
        self._place: dict[tuple[int, int], int] = {}
        self._file: BinaryIO | None = None

    def __enter__(self) -> BlockRaster:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("w+b")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
        self._path.unlink(missing_ok=True)

    def block(self, row: int, column: int) -> Float:
        """Return the block (bands, SIDE, SIDE) at a block row and column, to be changed in place."""
        key = row, column
        if key in self._cached:
            self._cached.move_to_end(key)
            return self._cached[key]
        block = self._stored(key)
        if block is None:
            block = np.full((self._bands, SIDE, SIDE), self._fill, np.float32)
            self._place[key] = len(self._place)
        self._cached[key] = block
        if len(self._cached) > MAX_BLOCKS:
            old, values = self._cached.popitem(last=False)
            self._store(old, values)
        return block

    def window(self, row: int, column: int, height: int, width: int) -> Float:
        """Return a copy (bands, height, width) of the pixels from (row, column) on; outside it is `fill`."""
        out = np.full((self._bands, height, width), self._fill, np.float32)
        for block_row in range(row // SIDE, -(-(row + height) // SIDE)):
            for block_column in range(column // SIDE, -(-(column + width) // SIDE)):
                if (block_row, block_column) not in self._place:
                    continue
                block = self.block(block_row, block_column)
                top, left = block_row * SIDE - row, block_column * SIDE - column
                rows = slice(max(top, 0), min(top + SIDE, height))
                columns = slice(max(left, 0), min(left + SIDE, width))
                out[:, rows, columns] = block[
                    :, rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
                ]
        return out

    def _stored(self, key: tuple[int, int]) -> Float | None:
        if key not in self._place or self._file is None:
            return None
        count = self._bands * SIDE * SIDE
        self._file.seek(self._place[key] * count * 4)
        return np.fromfile(self._file, np.float32, count).reshape(self._bands, SIDE, SIDE)

    def _store(self, key: tuple[int, int], values: Float) -> None:
        if self._file is not None:
            self._file.seek(self._place[key] * values.nbytes)
            values.tofile(self._file)
