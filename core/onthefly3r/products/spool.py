"""The fused cloud on disk between two passes: the first learns its extent and its ground, the second writes it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

from ..geometry.arrays import Bool, Float
from ..records import CloudTile

RECORD = np.dtype(
    [
        ("position", "<f8", 3),
        ("confidence", "<f4"),
        ("source", "<i4"),
        ("batch", "<i4"),
        ("views", "<i4"),
        ("rgb", "u1", 3),
    ],
    align=True,
)
BLOCK_SPACINGS = 256.0  # side of the blocks that the extent is found from
TAIL = 0.005  # share of the points that may lie outside the main part on each side of an axis
REACH = 0.5  # what lies this share of the main part's diagonal outside it is stray


@dataclass(frozen=True)
class Extent:
    """The box that holds the survey, without what lies absurdly far outside it."""

    low: Float  # (3,) m
    high: Float  # (3,) m

    def contains(self, points: Float) -> Bool:
        """Return which points (N, 3) lie in the box."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


class CloudSpool:
    """A temporary file of tiles; a context manager that removes it at the end."""

    def __init__(self, path: Path, spacing_m: float) -> None:
        """`path` is overwritten."""
        self._path, self._block_m = path, BLOCK_SPACINGS * spacing_m
        self._counts: list[int] = []
        self._blocks: dict[tuple[int, int, int], tuple[int, Float, Float]] = {}  # -> points, lowest and highest corner
        self._file: BinaryIO | None = None

    def __enter__(self) -> CloudSpool:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._path.open("wb")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
        self._path.unlink(missing_ok=True)

    def add(self, tile: CloudTile) -> None:
        """Append a tile."""
        if not len(tile.points):
            return
        assert self._file is not None
        record = np.zeros(len(tile.points), RECORD)
        record["position"], record["rgb"] = tile.points, tile.rgb
        record["confidence"], record["source"] = tile.confidence, tile.source
        record["batch"], record["views"] = tile.batch, tile.views
        record.tofile(self._file)
        self._counts.append(len(record))
        self._note_blocks(tile.points)

    @property
    def points(self) -> int:
        """How many points there are."""
        return sum(self._counts)

    @property
    def tile_count(self) -> int:
        """How many tiles there are."""
        return len(self._counts)

    @property
    def has_strays(self) -> bool:
        """Whether points lie outside `extent`."""
        extent = self.extent()
        return any(
            not (extent.contains(low[None]) & extent.contains(high[None])).all()
            for _, low, high in self._blocks.values()
        )

    def extent(self) -> Extent:
        """Return the box of the points that belong to the survey: clumps far outside the rest are not in it."""
        if not self._blocks:
            raise ValueError("a cloud without points has no extent")
        weight = np.array([count for count, _, _ in self._blocks.values()], float)
        low = np.array([corner for _, corner, _ in self._blocks.values()])
        high = np.array([corner for _, _, corner in self._blocks.values()])
        middle = (low + high) / 2.0
        main_low = np.array([_quantile(middle[:, k], weight, TAIL) for k in range(3)])
        main_high = np.array([_quantile(middle[:, k], weight, 1.0 - TAIL) for k in range(3)])
        reach = REACH * float(np.linalg.norm(main_high - main_low)) + self._block_m
        near = ((middle >= main_low - reach) & (middle <= main_high + reach)).all(axis=1)
        return Extent(low[near].min(axis=0), high[near].max(axis=0))

    def tiles(self) -> Iterator[CloudTile]:
        """Yield the tiles as they were added; nothing can be added afterwards."""
        self._close()
        with self._path.open("rb") as stream:
            for count in self._counts:
                record = np.fromfile(stream, RECORD, count)
                yield CloudTile(
                    points=record["position"],
                    rgb=record["rgb"],
                    confidence=record["confidence"],
                    source=record["source"],
                    batch=record["batch"],
                    views=record["views"],
                )

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _note_blocks(self, points: Float) -> None:
        block = np.floor(points / self._block_m).astype(np.int64)
        first = block.min(axis=0)
        size = block.max(axis=0) - first + 1
        key = ((block[:, 0] - first[0]) * size[1] + block[:, 1] - first[1]) * size[2] + block[:, 2] - first[2]
        _, index, inverse, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
        low, high = np.full((len(index), 3), np.inf), np.full((len(index), 3), -np.inf)
        for axis in range(3):
            np.minimum.at(low[:, axis], inverse, points[:, axis])
            np.maximum.at(high[:, axis], inverse, points[:, axis])
        for k, (x, y, z) in enumerate(block[index]):
            name = (int(x), int(y), int(z))
            known = self._blocks.get(name)
            if known is None:
                self._blocks[name] = (int(count[k]), low[k], high[k])
            else:
                n, known_low, known_high = known
                self._blocks[name] = (
                    n + int(count[k]),
                    np.minimum(known_low, low[k]),
                    np.maximum(known_high, high[k]),
                )


def _quantile(values: Float, weight: Float, share: float) -> float:
    order = np.argsort(values)
    at = int(np.searchsorted(np.cumsum(weight[order]), share * weight.sum()))
    return float(values[order[min(at, len(order) - 1)]])
