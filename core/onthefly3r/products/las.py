"""The point cloud as LAS 1.4 point format 7 (ASPRS LAS 1.4 R15), plain or compressed, written as it arrives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from .. import __version__
from ..errors import ReconstructionError
from ..files.atomic import replacing
from ..geometry.arrays import Float, Int
from ..geometry.spacing import point_spacing
from ..records import CloudTile

# OGC WKT 1 of a cloud that is not tied to the Earth: readers that insist on a CRS (QGIS hangs without) get one.
LOCAL_WKT1 = 'LOCAL_CS["Local frame, not georeferenced",LOCAL_DATUM["Local frame",0],UNIT["metre",1]]'
MAX_POINT_SOURCE = 65_535  # 16 bit; 0 is reserved for the writing software (LAS 1.4 R15, table 15)
INT32_RANGE = 2**31 - 1


WINDOW_STRIDE = 100  # every so many points are looked at for the window
WINDOW_TAIL = 0.005  # share of the points outside the window on each side


@dataclass(frozen=True)
class CloudSummary:
    """What was written, in the CRS of the file, m."""

    path: Path
    points: int
    bounds: tuple[float, float, float, float, float, float]  # min x, min y, min z, max x, max y, max z
    window: tuple[float, float, float, float]  # min x, min y, max x, max y without the outermost points
    mean_spacing_m: float


def las_scale_m(spacing_m: float) -> float:
    """Return the coordinate resolution for a point spacing: a millimetre, or the power of ten <= a tenth of it."""
    return float(min(1e-3, 10.0 ** np.floor(np.log10(spacing_m / 10.0) + 1e-9)))


class SpacingMeter:
    """How far apart the points of passing tiles lie, and the window that holds all but the outermost."""

    def __init__(self) -> None:
        self._spacing, self._counted = 0.0, 0
        self._sample: list[Float] = []

    def add(self, points: Float) -> None:
        """Look at the points (N, 3) of a tile."""
        self._sample.append(points[::WINDOW_STRIDE, :2].copy())
        spacing = point_spacing(points)
        if np.isfinite(spacing):
            self._spacing, self._counted = self._spacing + spacing * len(points), self._counted + len(points)

    @property
    def spacing_m(self) -> float:
        """The mean distance of neighbours."""
        return self._spacing / self._counted if self._counted else float("nan")

    @property
    def window(self) -> tuple[float, float, float, float]:
        """min x, min y, max x, max y without the outermost points."""
        low, high = np.quantile(np.concatenate(self._sample), [WINDOW_TAIL, 1.0 - WINDOW_TAIL], axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


class CloudWriter:
    """A LAS or LAZ file that is written tile by tile; a context manager, whose `summary` is there at its end.

    Red, green and blue are 16 bit (8 bit x 257). Point source id is the image number from 1 (shot index + 1); with
    more images than it can count, it is 0 and the extra dimension `image` holds the number. Further extra dimensions:
    `confidence` 0..255, `batch`, `n_views` (also in user data, which QGIS keeps), and `part` where the map is in parts
    that nothing connects. Every point is return 1 of 1, and of class 0 where the tiles are not classified.
    """

    def __init__(
        self,
        path: Path,
        wkt1: str | None,
        scale_m: float,
        description: str = "",
        n_images: int = 0,
        part_of: Int | None = None,
    ) -> None:
        """See `write_cloud` for the arguments."""
        self._path, self._wkt, self._scale_m = path, wkt1 or LOCAL_WKT1, scale_m
        self._description, self._wide, self._part_of = description, n_images > MAX_POINT_SOURCE, part_of
        self._files = ExitStack()
        self._writer: Any = None
        self._header: Any = None
        self._meter = SpacingMeter()
        self.summary: CloudSummary | None = None

    def __enter__(self) -> CloudWriter:
        return self

    def add(self, tile: CloudTile) -> None:
        """Write the points of a tile in the export frame."""
        if not len(tile.points):
            return
        if self._writer is None:
            self._open(np.round(tile.points.mean(axis=0)))
        self._writer.write_points(las_record(tile, self._header, self._wide, self._part_of))
        self._meter.add(tile.points)

    def _open(self, offset: Float) -> None:
        import laspy

        in_parts = self._part_of is not None
        self._header = las_header(offset, self._scale_m, self._wkt, self._description, self._wide, in_parts)
        temporary = self._files.enter_context(replacing(self._path))
        compress = self._path.suffix.lower() == ".laz"
        self._writer = self._files.enter_context(
            laspy.open(temporary, mode="w", header=self._header, do_compress=compress)
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._files.__exit__(kind, error, trace) or kind is not None:
            return
        if self._writer is None:
            raise ReconstructionError(
                "the cloud has no points; lower min_confidence, or look at the rejected images in the report"
            )
        written = self._writer.header
        (min_x, min_y, min_z), (max_x, max_y, max_z) = (map(float, ends) for ends in (written.mins, written.maxs))
        self.summary = CloudSummary(
            path=self._path,
            points=int(written.point_count),
            bounds=(min_x, min_y, min_z, max_x, max_y, max_z),
            window=self._meter.window,
            mean_spacing_m=self._meter.spacing_m,
        )


def write_cloud(
    path: Path,
    tiles: Iterator[CloudTile],
    wkt1: str | None,
    scale_m: float,
    description: str = "",
    n_images: int = 0,
    part_of: Int | None = None,
) -> CloudSummary:
    """Write the tiles one after the other as `CloudWriter` does, and return what the file holds.

    Args:
        path: final name, ending in .las or .laz.
        tiles: in the export frame, m; consumed once, one in memory at a time.
        wkt1: OGC WKT 1 of the CRS; None writes `LOCAL_WKT1`.
        scale_m: resolution of the stored coordinates, see `las_scale_m`.
        description: text kept in the file (LASF_Spec record 3).
        n_images: number of photographs given, decides where image numbers are kept.
        part_of: part of the map (N,) of each shot index; None where the map is one.

    Raises:
        ReconstructionError: no tile has a point, or the coordinates do not fit 32 bit at this scale.
    """
    with CloudWriter(path, wkt1, scale_m, description, n_images, part_of) as writer:
        for tile in tiles:
            writer.add(tile)
    assert writer.summary is not None
    return writer.summary


def las_header(offset: Float, scale_m: float, wkt1: str, description: str, wide: bool, in_parts: bool) -> Any:
    """Return a laspy header of our clouds; `wide` keeps image numbers in an extra dimension, `in_parts` parts."""
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, scale_m)
    header.offsets = offset
    header.generating_software = f"onthefly3r {__version__}"
    header.system_identifier = "EXTRACTION"  # LAS 1.4 R15: derived data, not a sensor's own
    extra = [("confidence", "uint8", "confidence, 255 = 1"), ("batch", "uint32", "batch of the image")]
    extra.append(("n_views", "uint8", "images that saw the point"))
    if wide:
        extra.append(("image", "uint32", "image number from 1"))
    if in_parts:
        extra.append(("part", "uint16", "part of the map, 1 = largest"))
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind, text) for name, kind, text in extra])
    # Not header.add_crs: it writes WKT 2, which point formats 6-10 do not allow.
    header.vlrs.append(WktCoordinateSystemVlr(wkt1))
    header.global_encoding.wkt = True
    if description:
        text = description.encode("utf-8", errors="backslashreplace")[:65_000] + b"\0"
        header.vlrs.append(laspy.VLR("LASF_Spec", 3, "Text area description", text))
    return header


def las_record(tile: CloudTile, header: Any, wide: bool, part_of: Int | None) -> Any:
    """Return the points of a tile as a record of laspy; `part_of` as for `write_cloud`."""
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(tile.points), header=header)
    stored = np.rint((tile.points - header.offsets) / header.scales)
    if np.abs(stored).max() > INT32_RANGE:
        reach_km = np.abs(tile.points - header.offsets).max() / 1000.0
        raise ReconstructionError(
            f"points {reach_km:.0f} km apart do not fit a LAS file with coordinates to {header.scales[0]:g} m; "
            "export with a larger spacing_m"
        )
    record.X, record.Y, record.Z = (stored[:, axis].astype(np.int32) for axis in range(3))
    record.red, record.green, record.blue = (tile.rgb[:, band].astype(np.uint16) * 257 for band in range(3))
    views = np.clip(tile.views, 0, 255).astype(np.uint8)
    record.return_number = record.number_of_returns = np.ones(len(tile.points), np.uint8)
    record.user_data = record["n_views"] = views
    if tile.classification is not None:
        record.classification = tile.classification
    record["confidence"] = np.rint(np.clip(tile.confidence, 0.0, 1.0) * 255.0).astype(np.uint8)
    record["batch"] = tile.batch.astype(np.uint32)
    if part_of is not None:
        record["part"] = part_of[tile.source].astype(np.uint16)
    image = tile.source.astype(np.int64) + 1
    if wide:
        record["image"] = image.astype(np.uint32)
    else:
        record.point_source_id = image.astype(np.uint16)
    return record
