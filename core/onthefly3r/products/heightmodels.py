"""Digital surface and terrain models, and the confidence of the surface, gathered from the tiles of the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from ..geometry.arrays import Bool, Float
from ..records import CloudTile
from .blockraster import SIDE, BlockRaster
from .cog import CogWriter, Grid
from .spool import Extent
from .terrain import Terrain

NODATA = -9999.0
WINDOW = 512
TOP_PIXELS = 1.0  # points this many pixels below the highest one of a pixel belong to its surface
MIN_GAP_PX = 2  # gaps up to twice so many pixels wide are between points, not holes
MAX_TERRAIN_GAP_M = 30.0  # the terrain is told no farther than this from ground that was seen
TOP, CONFIDENCE, GROUND, COUNT = range(4)


@dataclass(frozen=True)
class SurfaceRasters:
    """What was written."""

    grid: Grid
    paths: dict[str, Path]  # dsm, dtm, confidence
    coverage_m2: float  # of the surface model


class SurfaceSink:
    """Gathers the surface on disk while the tiles pass, and writes dsm.tif, dtm.tif and confidence.tif at the end."""

    def __init__(
        self,
        folder: Path,
        work: Path,
        extent: Extent,
        pixel_m: float,
        terrain: Terrain | None,
        crs: str | None,
        fill_m: float,
        tags: dict[str, str],
    ) -> None:
        """`fill_m`: holes are closed up to this distance from the surface, m; `terrain` None writes no dtm.tif."""
        first = np.floor(extent.low[:2] / pixel_m)
        last = np.floor(extent.high[:2] / pixel_m) + 1
        width, height = (int(n) for n in last - first)
        self.grid = Grid(float(first[0] * pixel_m), float(last[1] * pixel_m), pixel_m, width, height)
        self._folder, self._terrain, self._crs, self._tags = folder, terrain, crs, tags
        self._base_m = float(np.floor(extent.low[2]))  # float32 keeps millimetres above it
        self._gap_px = max(MIN_GAP_PX, int(np.ceil(fill_m / pixel_m)))
        self._raster = BlockRaster(work / "surface.bin", 4, np.nan)
        self.summary: SurfaceRasters | None = None

    def __enter__(self) -> SurfaceSink:
        self._raster.__enter__()
        return self

    def add(self, tile: CloudTile) -> None:
        """Take the points of a tile in the export frame."""
        grid = self.grid
        column = np.floor((tile.points[:, 0] - grid.west) / grid.pixel_m).astype(np.int64)
        row = np.floor((grid.north - tile.points[:, 1]) / grid.pixel_m).astype(np.int64)
        ok = (column >= 0) & (row >= 0) & (column < grid.width) & (row < grid.height)
        if not ok.any():
            return
        column, row = column[ok], row[ok]
        z = (tile.points[ok, 2] - self._base_m).astype(np.float32)
        pixel = row * grid.width + column
        order = np.lexsort((z, pixel))
        pixel, z, confidence = pixel[order], z[order], np.asarray(tile.confidence, np.float32)[ok][order]
        starts = np.flatnonzero(np.diff(pixel, prepend=-1))
        sizes = np.diff(starts, append=len(pixel))
        highest = np.repeat(z[starts + sizes - 1], sizes)
        on_top = (z >= highest - TOP_PIXELS * grid.pixel_m).astype(np.float32)
        count = np.add.reduceat(on_top, starts)
        found = np.full((4, len(starts)), np.nan, np.float32)
        found[TOP] = np.add.reduceat(on_top * z, starts) / count
        found[CONFIDENCE] = np.add.reduceat(on_top * confidence, starts) / count
        if tile.classification is not None:
            ground = (tile.classification[ok][order] == 2).astype(np.float32)
            found[GROUND], found[COUNT] = np.add.reduceat(ground * z, starts), np.add.reduceat(ground, starts)
        self._merge(pixel[starts] // grid.width, pixel[starts] % grid.width, found)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._write()
        finally:
            self._raster.__exit__(kind, error, trace)

    def _merge(self, row: Float, column: Float, found: Float) -> None:
        block = (row // SIDE) * (self.grid.width // SIDE + 1) + column // SIDE
        for key in np.unique(block):
            of = block == key
            at = row[of] % SIDE, column[of] % SIDE
            values = self._raster.block(int(row[of][0] // SIDE), int(column[of][0] // SIDE))
            new, old = found[:, of], values[:, at[0], at[1]]
            higher = ~(old[TOP] >= new[TOP])  # also where there was nothing
            for band in (TOP, CONFIDENCE):
                values[band][at] = np.where(higher, new[band], old[band])
            for band in (GROUND, COUNT):
                values[band][at] = np.nan_to_num(old[band]) + np.nan_to_num(new[band])

    def _write(self) -> None:
        names = ("dsm", "dtm", "confidence") if self._terrain is not None else ("dsm", "confidence")
        kinds = {
            "dsm": ("float32", "height of the surface", NODATA),
            "dtm": ("float32", "height of the ground", NODATA),
            "confidence": ("float32", "confidence of the surface, 0 to 1", NODATA),
        }
        paths = {name: self._folder / f"{name}.tif" for name in names}
        writers = {
            name: CogWriter(paths[name], self.grid, self._crs, kind, [text], nodata=nodata, tags=self._tags)
            for name, (kind, text, nodata) in kinds.items()
            if name in paths
        }
        from contextlib import ExitStack

        covered = 0
        with ExitStack() as stack:
            for writer in writers.values():
                stack.enter_context(writer)
            for row, column, height, width in self.grid.windows(WINDOW):
                dsm, dtm, confidence = self._window(row, column, height, width)
                covered += int(np.isfinite(dsm).sum())
                for name, values in (("dsm", dsm), ("dtm", dtm), ("confidence", confidence)):
                    if name in writers:
                        writers[name].write(row, column, np.where(np.isfinite(values), values, NODATA)[None])
        self.summary = SurfaceRasters(self.grid, paths, covered * self.grid.pixel_m**2)

    def _window(self, row: int, column: int, height: int, width: int) -> tuple[Float, Float, Float]:
        """Return surface, terrain and confidence of a window, NaN where nothing is known."""
        margin = 2 * self._gap_px + 2
        values = self._raster.window(row - margin, column - margin, height + 2 * margin, width + 2 * margin)
        inside = slice(margin, margin + height), slice(margin, margin + width)
        known = np.isfinite(values[TOP])
        held = closed(known, self._gap_px)
        dsm = _filled(values[TOP], known, held, self._gap_px)[inside] + self._base_m
        dtm = np.full_like(dsm, np.nan)
        if self._terrain is not None:
            x, y = self.grid.centres(row - margin, column - margin, height + 2 * margin, width + 2 * margin)
            x, y = np.meshgrid(x, y)
            below = self._terrain.at(x, y)
            count = values[COUNT]
            with np.errstate(invalid="ignore", divide="ignore"):
                seen = count > 0
                ground = np.where(seen, values[GROUND] / count + self._base_m - below, 0.0).astype(np.float32)
            # What the grid of the terrain leaves out where ground is seen, fading away from there.
            detail = _filled(ground, seen, np.ones_like(seen), margin) if seen.any() else np.zeros_like(below)
            told = held & (self._terrain.gap_m(x, y) <= MAX_TERRAIN_GAP_M)
            dtm = np.where(told, below + np.nan_to_num(detail), np.nan)[inside]
        return dsm, dtm, np.where(known, values[CONFIDENCE], np.nan)[inside]


def closed(known: Bool, reach_px: float) -> Bool:
    """Return the known pixels with holes and gaps closed that are at most twice `reach_px` wide; outlines stay."""
    import cv2

    if not known.any():
        return known
    near = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5) <= reach_px
    # The border of the window is no border of the surface: it is taken as near.
    padded = np.pad(near, 1, constant_values=True).astype(np.uint8)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    return np.asarray(known | (near & (depth > reach_px)))


def _filled(values: Float, known: Bool, wanted: Bool, reach_px: int) -> Float:
    """Return the values with unknown pixels that are wanted interpolated from known ones; NaN elsewhere."""
    from rasterio.fill import fillnodata

    result = np.where(known, values, np.nan).astype(np.float32)
    missing = wanted & ~known
    if known.any() and missing.any():
        filled = fillnodata(
            np.where(known, values, 0.0).astype(np.float32),
            mask=known.astype(np.uint8),
            max_search_distance=float(reach_px + 1),
        )
        # Pixels that the search did not reach hold the zero that was put there; they stay unknown.
        reached = fillnodata(
            np.where(known, 1.0, 0.0).astype(np.float32),
            mask=known.astype(np.uint8),
            max_search_distance=float(reach_px + 1),
        )
        result = np.where(missing & (reached > 0.5), filled, result)
    return result
