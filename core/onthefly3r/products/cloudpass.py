"""The cloud, fused once, handed tile by tile to everything that is made from it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from ..cloud.dense_cloud import dense_points, point_spacing_m
from ..cloud.fuse import fuse
from ..errors import InputError, ReconstructionError
from ..records import CloudTile, GeoReference
from .clip import Boundary, clipped, read_boundary
from .runview import RunView
from .spool import CloudSpool, Extent
from .terrain import LowestPoints, Terrain, find_terrain

UNCLASSIFIED, GROUND_CLASS = 1, 2  # ASPRS LAS 1.4 R15, table 17


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


@dataclass(frozen=True)
class Cloud:
    """What is known of the cloud before it is handed out."""

    spacing_m: float  # voxel size
    points: int
    left_out: int  # points that lie far outside the survey
    tiles: int
    extent: Extent
    terrain: Terrain | None  # None where the ground was not asked for, or lengths are not metres


@contextmanager
def gathered(view: RunView) -> Iterator[tuple[Cloud, Iterator[CloudTile]]]:
    """Fuse the cloud to disk, and yield what is known of it and its tiles, classified and without far strays.

    Raises `ReconstructionError` when the cloud has no points.
    """
    spacing_m = cloud_spacing_m(view)
    with CloudSpool(view.work / "cloud.bin", spacing_m) as spool:
        lowest = LowestPoints(spacing_m)
        for tile in cloud_tiles(view):
            spool.add(tile)
            lowest.add(tile.points)
        if not spool.points:
            raise ReconstructionError(
                "the cloud has no points; lower min_confidence, or look at the rejected images in the report"
            )
        extent = spool.extent()
        terrain = find_terrain(lowest, extent) if view.options.export.ground and view.frame.metric else None
        inside = sum(int(extent.contains(tile.points).sum()) for tile in spool.tiles()) if spool.has_strays else None
        points = spool.points if inside is None else inside
        yield (
            Cloud(spacing_m, points, spool.points - points, spool.tile_count, extent, terrain),
            _handed_out(spool, extent, terrain),
        )


def _handed_out(spool: CloudSpool, extent: Extent, terrain: Terrain | None) -> Iterator[CloudTile]:
    for tile in spool.tiles():
        if spool.has_strays:
            tile = tile.only(extent.contains(tile.points))
        if terrain is not None and len(tile.points):
            ground = terrain.is_ground(tile.points)
            tile = replace(tile, classification=np.where(ground, GROUND_CLASS, UNCLASSIFIED).astype(np.uint8))
        yield tile


def cloud_spacing_m(view: RunView) -> float:
    """Return the voxel size of the fused cloud."""
    quality = view.options.export.quality
    return view.options.export.spacing_m or point_spacing_m(view.state, view.shots, view.frame.level_from_map, quality)


def cloud_tiles(view: RunView) -> Iterator[CloudTile]:
    """Yield the fused cloud in the export frame, cut to the boundary where there is one."""
    fused = fuse(
        dense_points(
            view.state,
            view.store,
            view.shots,
            view.frame.level_from_map,
            view.options,
            view.work,
            view.checkpoint,
            view.dense,
        ),
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


def _boundary(path: Path, reference: GeoReference | None) -> Boundary:
    if reference is None:
        raise InputError("a boundary needs a georeferenced cloud: leave out --local or the boundary")
    return read_boundary(path, reference.crs)
