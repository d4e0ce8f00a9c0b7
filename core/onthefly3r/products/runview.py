"""What products are written from: a run that ended, or as much of it as there is, in one frozen object."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from .. import __version__
from ..cloud.figures import DenseFigures
from ..geometry.geodesy import VERTICAL_NAMES
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..records import ControlResidual, GeoReference, PlacedCamera, RefusedPhotograph, Rejection, Shot
from .cameras import camera_rows, footprints, placed_cameras
from .exportframe import ExportFrame
from .footprints import Footprint
from .rows import CameraRow


@dataclass(frozen=True)
class RunView:
    """A run as its products see it; cameras, rows and footprints are worked out when first asked for."""

    title: str
    options: Options
    state: MapState
    store: Store
    shots: Mapping[int, Shot]
    rejections: Mapping[int, Rejection]
    retries: Mapping[int, int]
    refused: Sequence[RefusedPhotograph]
    reference: GeoReference | None  # None: local coordinates
    frame: ExportFrame
    work: Path  # for temporary files
    checkpoint: Callable[[str, int, int], None]  # (stage, done, total); may raise `Cancelled`

    @property
    def crs(self) -> str | None:
        """The projected CRS of the files, None for local coordinates."""
        return self.reference.crs if self.reference else None

    @property
    def unit(self) -> str:
        """The unit of lengths in the files."""
        return "m" if self.frame.metric else "map units"

    @cached_property
    def dense(self) -> DenseFigures:
        """What is known of the dense cloud; complete once it is written."""
        return DenseFigures(self.options.export.quality, self.frame.metric)

    @cached_property
    def cameras(self) -> list[PlacedCamera]:
        """The placed cameras in the export frame, at photograph size, in the order of the shots."""
        return placed_cameras(self.state, self.shots, self.retries, self.frame)

    @cached_property
    def rows(self) -> list[CameraRow]:
        """One row per photograph, placed ones first, both in capture order."""
        return camera_rows(
            self.cameras,
            self.state,
            self.shots,
            self.rejections,
            self.retries,
            self.reference,
            self.frame,
            self.options,
        )

    @cached_property
    def footprints(self) -> list[Footprint]:
        """What the placed cameras cover on the ground."""
        return footprints(self.cameras, self.state, self.frame)

    @property
    def control(self) -> list[tuple[ControlResidual, tuple[float, float, float]]]:
        """Control points and checkpoints, each with its coordinates in the files; NaN for an unknown height."""
        placed = []
        for point in self.reference.control if self.reference else ():
            east, north, up = point.enu_m
            x, y, z = self.frame.from_level(np.array([[east, north, up if math.isfinite(up) else 0.0]]))[0]
            placed.append((point, (float(x), float(y), float(z) if math.isfinite(up) else math.nan)))
        return placed


def raster_tags(view: RunView) -> dict[str, str]:
    """Return what rasters say of themselves: software, title, and what heights refer to."""
    tags = {"TIFFTAG_SOFTWARE": f"onthefly3r {__version__}", "TIFFTAG_DOCUMENTNAME": view.title}
    vertical = view.reference.vertical if view.reference else None
    return {**tags, "HEIGHTS": VERTICAL_NAMES[vertical] if vertical else "local, not georeferenced"}
