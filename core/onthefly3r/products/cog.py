"""Cloud Optimized GeoTIFF, written window by window."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..files.atomic import replacing
from ..geometry.arrays import Float

TILE = 512
CACHE_MIB = 128  # of GDAL; its default is a share of the machine's memory


@dataclass(frozen=True)
class Grid:
    """Square pixels in the export frame; row 0 is the northern edge."""

    west: float
    north: float
    pixel_m: float
    width: int
    height: int

    @property
    def transform(self) -> Any:
        """The affine transformation from pixels to the export frame."""
        from rasterio import Affine

        return Affine(self.pixel_m, 0.0, self.west, 0.0, -self.pixel_m, self.north)

    def windows(self, side: int) -> Iterator[tuple[int, int, int, int]]:
        """Yield (row, column, height, width) of square windows, back and forth, so that neighbours come together."""
        for number, row in enumerate(range(0, self.height, side)):
            columns = range(0, self.width, side)
            for column in columns if number % 2 == 0 else reversed(columns):
                yield row, column, min(side, self.height - row), min(side, self.width - column)

    def centres(self, row: int, column: int, height: int, width: int) -> tuple[Float, Float]:
        """Return x (width,) and y (height,) of the pixel centres of a window."""
        x = self.west + (column + np.arange(width) + 0.5) * self.pixel_m
        y = self.north - (row + np.arange(height) + 0.5) * self.pixel_m
        return x, y


class CogWriter:
    """A raster that is written in windows and turned into a Cloud Optimized GeoTIFF at the end; a context manager."""

    def __init__(
        self,
        path: Path,
        grid: Grid,
        crs: str | None,
        dtype: str,
        bands: Sequence[str],
        *,
        nodata: float | None = None,
        alpha: bool = False,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """`bands` are their descriptions; with `alpha` the last one is the opacity; `crs` None writes none."""
        self._path, self._grid, self._crs, self._dtype = path, grid, crs, dtype
        self._bands, self._nodata, self._alpha, self._tags = bands, nodata, alpha, dict(tags or {})
        self._dataset: Any = None
        self._temporary = path.with_name(f".{path.stem}.windows.tif")

    def __enter__(self) -> CogWriter:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        import rasterio
        from rasterio.enums import ColorInterp

        with rasterio.Env(GDAL_CACHEMAX=CACHE_MIB):
            self._dataset = rasterio.open(
                self._temporary,
                "w",
                driver="GTiff",
                width=self._grid.width,
                height=self._grid.height,
                count=len(self._bands),
                dtype=self._dtype,
                crs=self._crs,
                transform=self._grid.transform,
                nodata=self._nodata,
                tiled=True,
                blockxsize=TILE,
                blockysize=TILE,
                compress="deflate",
                zlevel=1,
                interleave="pixel",
                bigtiff="if_safer",
                sparse_ok=True,
                **({"photometric": "rgb", "alpha": "yes"} if self._alpha else {}),
            )
        for number, name in enumerate(self._bands, start=1):
            self._dataset.set_band_description(number, name)
        if self._alpha:
            self._dataset.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        self._dataset.update_tags(**self._tags)
        return self

    def write(self, row: int, column: int, values: Any) -> None:
        """Write values (bands, height, width) from (row, column) on."""
        from rasterio.windows import Window

        self._dataset.write(values, window=Window(column, row, values.shape[2], values.shape[1]))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._dataset.close()
        try:
            if kind is None:
                self._convert()
        finally:
            self._temporary.unlink(missing_ok=True)

    def _convert(self) -> None:
        import rasterio
        from rasterio.shutil import copy

        floating = self._dtype.startswith("float")
        with (
            replacing(self._path) as temporary,
            rasterio.Env(GDAL_CACHEMAX=CACHE_MIB, GDAL_NUM_THREADS="1"),
        ):
            copy(
                self._temporary,
                temporary,
                driver="COG",
                blocksize=TILE,
                compress="deflate",
                level="1",
                predictor="floating_point" if floating else "standard",
                overview_resampling="average",
                bigtiff="if_safer",
            )
