"""`footprints.shp`: what each placed photograph covers on the ground, and how many others cover it too."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..files.atomic import replacing
from ..geometry.arrays import Float
from ..records import PlacedCamera
from .clip import in_ring
from .vector import fit_text, write_companions

# Oblique views see to the horizon: a footprint ends where the ground is this many flying heights away.
MAX_REACH = 4.0
FIELDS = (
    ("image", "C", 254, 0),
    ("number", "N", 9, 0),
    ("gsd_m", "N", 12, 5),
    ("area_m2", "N", 16, 2),
    ("overlap", "N", 6, 0),
)


@dataclass(frozen=True)
class Footprint:
    """The ground that one photograph covers, in the export frame."""

    image: str
    number: int  # shot index + 1, as in `rows.CameraRow`
    outline: Float  # (8, 2) corners and mid-edges, clockwise, m
    gsd_m: float  # ground sampling distance at the centre of the outline
    overlap: int = 1  # photographs that cover the centre of the outline, this one included

    @property
    def centre(self) -> Float:
        """The mean of the outline (2,)."""
        return np.asarray(self.outline.mean(axis=0))

    @property
    def area_m2(self) -> float:
        """The area of the outline (shoelace formula)."""
        x, y = (self.outline - self.centre).T  # projected coordinates are large, and their products lose digits
        return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0)


def footprint(camera: PlacedCamera, ground_z_m: float) -> Footprint | None:
    """Return the outline of a photograph on the horizontal plane at `ground_z_m`; None when it looks away from it."""
    intrinsics, centre = camera.camera, camera.world_from_cam.translation
    height_m = float(centre[2]) - ground_z_m
    if height_m <= 0.0:
        return None
    w, h = float(intrinsics.width), float(intrinsics.height)
    border = np.array([[0, 0], [w / 2, 0], [w, 0], [w, h / 2], [w, h], [w / 2, h], [0, h], [0, h / 2]])
    rays = intrinsics.rays(border) @ camera.world_from_cam.rotation.T
    if not (rays[:, 2] < 0.0).any():
        return None
    level = np.linalg.norm(rays[:, :2], axis=1)
    # Reach on the ground per ray; rays at or above the horizon are cut like those that reach too far.
    down = np.maximum(-rays[:, 2], level / MAX_REACH)
    outline = centre[:2] + rays[:, :2] * (height_m / down)[:, None]
    slant_m = float(np.linalg.norm([*(outline.mean(axis=0) - centre[:2]), height_m]))
    return Footprint(camera.name, camera.index + 1, outline, slant_m / max(intrinsics.fx, intrinsics.fy))


def with_overlap(footprints: Sequence[Footprint]) -> list[Footprint]:
    """Return the footprints with the number of outlines that hold each one's centre."""
    if not footprints:
        return []
    centres = np.array([f.centre for f in footprints])
    counts = np.zeros(len(footprints), int)
    for item in footprints:
        counts += in_ring(centres, item.outline)
    return [replace(item, overlap=int(count)) for item, count in zip(footprints, counts, strict=True)]


def write_footprints(path: Path, footprints: Iterable[Footprint], crs: str | None) -> int:
    """Write `path` (.shp, polygons) with its companions and return their number; `crs` as in `vector.write_cameras`."""
    import shapefile

    count = 0
    with replacing(path, companions=(".shx", ".dbf", ".cpg", ".prj")) as temporary:
        with shapefile.Writer(str(temporary), shapeType=shapefile.POLYGON, encoding="utf-8") as writer:
            for name, kind, width, decimals in FIELDS:
                writer.field(name, kind, size=width, decimal=decimals)
            for item in footprints:
                ring = _clockwise(item.outline)
                writer.poly([[*ring.tolist(), ring[0].tolist()]])
                name = fit_text(item.image, 254, keep_end=True)
                writer.record(name, item.number, item.gsd_m, item.area_m2, item.overlap)
                count += 1
        write_companions(temporary, path, crs)
    return count


def _clockwise(ring: Float) -> Float:
    """Shapefiles want outer rings clockwise."""
    x, y = ring.T
    return ring if x @ np.roll(y, -1) - y @ np.roll(x, -1) < 0.0 else ring[::-1]
