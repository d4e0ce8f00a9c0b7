"""From the map to the coordinates in the files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..earth.georef import world_frame
from ..geometry.arrays import Float
from ..geometry.geodesy import WorldFrame, wkt1
from ..geometry.transforms import Rigid3, Sim3
from ..records import GeoReference


@dataclass(frozen=True)
class ExportFrame:
    """From the map to the coordinates in the files: a projected CRS, or the levelled map itself."""

    level_from_map: Sim3  # to east-north-up metres, or to the levelled map
    world: WorldFrame | None  # None: coordinates stay in the levelled map
    metric: bool = True  # whether the unit is the metre

    @classmethod
    def of(cls, reference: GeoReference) -> ExportFrame:
        """Return the frame of a georeference."""
        return cls(reference.enu_from_map, world_frame(reference))

    @property
    def wkt(self) -> str | None:
        """WKT 1 of the CRS, None without one."""
        return wkt1(self.world.crs, self.world.vertical) if self.world else None

    def points(self, map_points: Float) -> Float:
        """Map points (N, 3) of the map frame."""
        return self.from_level(self.level_from_map.apply(np.asarray(map_points, float)))

    def from_level(self, level_points: Float) -> Float:
        """Map points (N, 3) in metres of the levelled frame."""
        return self.world.from_enu(level_points) if self.world else level_points

    def pose(self, map_from_cam: Rigid3) -> Rigid3:
        """Map a camera pose; the meridian convergence turns the axes of a projected CRS."""
        level = self.level_from_map.apply_to_pose(map_from_cam)
        if self.world is None:
            return level
        turn = self.world.rotation_world_from_enu(level.translation)
        return Rigid3(turn @ level.rotation, self.world.from_enu(level.translation[None])[0])

    def convergence_deg(self, map_from_cam: Rigid3) -> float:
        """Return the angle from true to grid north at a camera, clockwise; 0 without a CRS."""
        if self.world is None:
            return 0.0
        turn = self.world.rotation_world_from_enu(self.level_from_map.apply(map_from_cam.translation))
        return float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
