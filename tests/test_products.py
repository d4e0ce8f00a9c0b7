"""From the map to the coordinates in the files."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.geometry.frames import enu_from_cam_rotation, gimbal_angles_deg
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.transforms import Rigid3, Sim3
from onthefly3r.products import ExportFrame


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:3035"])
@pytest.mark.parametrize("lon_deg", [12.5, 17.5])
def test_grid_yaw_and_convergence_give_back_the_true_yaw(crs: str, lon_deg: float) -> None:
    frame = ExportFrame(Sim3(), WorldFrame(crs, "ellipsoidal", EnuFrame(48.0, lon_deg, 300.0)))
    map_from_cam = Rigid3(enu_from_cam_rotation(35.0, -60.0, 0.0), np.array([10.0, -20.0, 80.0]))
    grid_yaw_deg, pitch_deg, _ = gimbal_angles_deg(frame.pose(map_from_cam).rotation)
    assert abs(grid_yaw_deg - 35.0) > 1.0  # the grid's north is another one here
    assert grid_yaw_deg + frame.convergence_deg(map_from_cam) == pytest.approx(35.0, abs=0.01)
    assert pitch_deg == pytest.approx(-60.0, abs=0.01)
