"""The cloud, fused once, handed tile by tile to everything that is made from it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from ..cloud.fuse import fuse
from ..errors import InputError
from ..records import CloudTile, GeoReference
from .clip import Boundary, clipped, read_boundary
from .runview import RunView


class Sink(Protocol):
    """What takes the tiles of the cloud in the export frame, and has something to show for it at the end."""

    def __enter__(self) -> Sink:
        """Begin."""
        ...

    def add(self, tile: CloudTile) -> None:
        """Take one tile."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End; after an exception nothing may be left behind."""
        ...

    @property
    def summary(self) -> Any:
        """What was made, once the sink has ended."""
        ...


def cloud_spacing_m(view: RunView) -> float:
    """Return the voxel size of the fused cloud."""
    return view.options.export.spacing_m or view.frame.level_from_map.scale * view.state.spacing


def cloud_tiles(view: RunView) -> Iterator[CloudTile]:
    """Yield the fused cloud in the export frame, cut to the boundary where there is one."""
    fused = fuse(
        _observed(view),
        cloud_spacing_m(view),
        view.options.export.min_confidence,
        view.work / "fusion",
        view.options.export.stray_filter,
        lambda done, total: view.checkpoint("fusing the cloud", done, total),
        view.options.backbone.threads or os.cpu_count() or 1,
    )
    # Fused before it is projected: a fifth of the points are left then.
    tiles: Iterator[CloudTile] = (replace(tile, points=view.frame.from_level(tile.points)) for tile in fused)
    if view.options.export.boundary is not None:
        tiles = clipped(tiles, _boundary(Path(view.options.export.boundary), view.reference))
    return tiles


def _observed(view: RunView) -> Iterator[CloudTile]:
    """Yield the points of each photograph in the levelled frame."""
    for done, stored in enumerate(view.store.stream_points(), start=1):
        view.checkpoint("collecting points", done, len(view.state.frames))
        count = len(stored.points)
        if count == 0:
            continue
        level_from_submap = view.frame.level_from_map @ view.state.submap_pose_of(stored.index)
        yield CloudTile(
            points=level_from_submap.apply(stored.points.astype(float)),
            rgb=stored.rgb,
            confidence=stored.confidence.astype(np.float32) / np.float32(255.0),
            source=np.full(count, stored.index, np.int32),
            batch=np.full(count, stored.submap, np.int32),
            views=np.ones(count, np.int32),
        )


def _boundary(path: Path, reference: GeoReference | None) -> Boundary:
    if reference is None:
        raise InputError("a boundary needs a georeferenced cloud: leave out --local or the boundary")
    return read_boundary(path, reference.crs)
