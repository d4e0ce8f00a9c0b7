"""The frame of the COLMAP model: metres about a point of the survey, along the grid of the CRS, with its offset told.

A projected CRS stretches lengths and has coordinates of millions of metres; neither is anything that a program which
projects points into cameras can use. So the model is in true metres, and `offset.json` says where they belong.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..files.atomic import write_text
from ..geometry.arrays import Float
from ..geometry.geodesy import EnuFrame, WorldFrame
from ..geometry.transforms import Sim3
from .exportframe import ExportFrame

STEP_M = 50.0  # over which the scale of the projection is taken


def local_from_map(frame: ExportFrame) -> Sim3:
    """Return the similarity from the map to the model's frame: metres about the origin, turned to grid north."""
    if frame.world is None:
        return frame.level_from_map
    return Sim3(1.0, frame.world.rotation_world_from_enu(), np.zeros(3)) @ frame.level_from_map


def write_offset(folder: Path, frame: ExportFrame) -> None:
    """Write offset.txt (x y z of the model's origin in the CRS) and offset.json (CRS and the exact affine map)."""
    if frame.world is None:
        told: dict[str, Any] = {"crs": None, "unit": "m" if frame.metric else "map units"}
        write_text(folder / "offset.txt", "0 0 0\n")
    else:
        matrix = _crs_from_local(frame.world)
        enu: EnuFrame = frame.world.enu
        told = {
            "crs": frame.world.crs,
            "vertical": frame.world.vertical,
            "unit": "m",
            "offset": matrix[:3, 3].tolist(),
            "crs_from_model": matrix.tolist(),
            "origin_wgs84": [enu.lat_deg, enu.lon_deg, enu.height_m],
        }
        write_text(folder / "offset.txt", " ".join(f"{v:.4f}" for v in matrix[:3, 3]) + "\n")
    write_text(folder / "offset.json", json.dumps(told, indent=2) + "\n")


def _crs_from_local(world: WorldFrame) -> Float:
    """Return the affine map (4, 4) from the model to the CRS: offset, and the scale of the projection there."""
    turn = world.rotation_world_from_enu()
    steps = STEP_M * np.eye(3)
    ahead, behind = (world.from_enu((sign * steps) @ turn) for sign in (1.0, -1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = (ahead - behind).T / (2.0 * STEP_M)
    matrix[:3, 3] = world.from_enu(np.zeros((1, 3)))[0]
    return matrix
