"""The COLMAP model of a run: multi-view tracks that other programs take, in the pixels of the files as stored."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.adjust.refine import refine
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.transforms import Sim3
from onthefly3r.products.cameras import placed_cameras
from onthefly3r.products.exportframe import ExportFrame
from onthefly3r.products.sparsepoints import write_colmap
from test_adjust_refine import drifted_map


@pytest.fixture(scope="module")
def truth() -> synthetic.Block:
    return synthetic.block(noise_px=0.3, n_points=1500)


def written(folder: Path, truth: synthetic.Block, frame: ExportFrame, orientation: int = 1) -> Path:
    state, store = drifted_map(folder / "work", truth)
    shots = {i: replace(shot, orientation=orientation) for i, shot in synthetic.shots(truth).items()}
    refined = refine(state, store.stream_observations(), shots)
    assert refined is not None
    state.move_refined(refined.map_from_submap, refined.calibrations)
    write_colmap(folder / "colmap", placed_cameras(state, shots, {}, frame), state, store, shots, frame)
    return folder / "colmap"


def test_colmaps_own_adjustment_takes_it(tmp_path: Path, truth: synthetic.Block) -> None:
    """Its tracks have several views, and it has next to nothing to improve: noise of 0.3 px, 0.38 px of length."""
    from onthefly3r.features.pycolmap_module import load_pycolmap

    pycolmap = load_pycolmap()
    folder = written(tmp_path, truth, ExportFrame(Sim3(), None, True), orientation=8)
    model = pycolmap.Reconstruction(str(folder))
    model.update_point_3d_errors()
    before = model.compute_mean_reprojection_error()
    assert model.compute_mean_track_length() > 2.5
    assert before < 0.5
    camera = next(iter(model.cameras.values()))
    assert (camera.width, camera.height) == (750, 1000)  # as stored, turned by a quarter
    pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    model.update_point_3d_errors()
    assert 0.9 * before < model.compute_mean_reprojection_error() < 1.1 * before


def test_coordinates_are_local_and_the_offset_is_told(tmp_path: Path, truth: synthetic.Block) -> None:
    world = WorldFrame("EPSG:32633", "ellipsoidal", EnuFrame(48.2, 14.0, 300.0))
    folder = written(tmp_path, truth, ExportFrame(Sim3(), world, True))
    lines = (folder / "points3D.txt").read_text().splitlines()[1:]
    points = np.array([line.split()[1:4] for line in lines], float)
    assert np.abs(points).max() < 1000.0
    told = json.loads((folder / "offset.json").read_text())
    matrix = np.array(told["crs_from_model"])
    there = points @ matrix[:3, :3].T + matrix[:3, 3]
    turn = world.rotation_world_from_enu()
    assert np.abs(there - world.from_enu(points @ turn)).max() < 0.01
    assert np.allclose(np.array((folder / "offset.txt").read_text().split(), float), matrix[:3, 3], atol=1e-4)
