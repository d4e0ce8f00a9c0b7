"""From the map to the coordinates in the files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.geometry.frames import enu_from_cam_rotation, gimbal_angles_deg
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.transforms import Rigid3, Sim3
from onthefly3r.options import Options
from onthefly3r.products.cameras import camera_rows, placed_cameras
from onthefly3r.products.exportframe import ExportFrame
from onthefly3r.records import Rejection
from oracle_runs import run, survey_of


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:3035"])
@pytest.mark.parametrize("lon_deg", [12.5, 17.5])
def test_grid_yaw_and_convergence_give_back_the_true_yaw(crs: str, lon_deg: float) -> None:
    frame = ExportFrame(Sim3(), WorldFrame(crs, "ellipsoidal", EnuFrame(48.0, lon_deg, 300.0)))
    map_from_cam = Rigid3(enu_from_cam_rotation(35.0, -60.0, 0.0), np.array([10.0, -20.0, 80.0]))
    grid_yaw_deg, pitch_deg, _ = gimbal_angles_deg(frame.pose(map_from_cam).rotation)
    assert abs(grid_yaw_deg - 35.0) > 1.0  # the grid's north is another one here
    assert grid_yaw_deg + frame.convergence_deg(map_from_cam) == pytest.approx(35.0, abs=0.01)
    assert pitch_deg == pytest.approx(-60.0, abs=0.01)


def test_rows_are_in_capture_order_whatever_order_the_shots_came_in(tmp_path: Path) -> None:
    engine = run(tmp_path, survey_of(24, 2), shuffle=3).engine
    state, frame = engine.state, ExportFrame(Sim3(), None, False)
    placed = placed_cameras(state, engine.shots, {}, frame)
    refused = {camera.index: Rejection((), "queries", "moved") for camera in placed[:4]}
    shots = dict(engine.shots)
    untimed = placed[-1].index
    shots[untimed] = replace(shots[untimed], time_s=None)
    rows = camera_rows(placed[4:], state, shots, refused, {}, None, frame, Options())
    by_name = {shot.name: shot for shot in shots.values()}
    for status, count in (("placed", len(placed) - 4), ("rejected", 4)):
        times = [by_name[row.image].time_s for row in rows if row.status == status]
        known = [time for time in times if time is not None]
        assert len(times) == count
        assert known == sorted(known)
    assert [row.status for row in rows] == ["placed"] * (len(placed) - 4) + ["rejected"] * 4
    last_placed = rows[len(placed) - 5]
    assert (last_placed.image, last_placed.number) == (shots[untimed].name, untimed + 1)
    assert all(shots[row.number - 1].name == row.image for row in rows)
