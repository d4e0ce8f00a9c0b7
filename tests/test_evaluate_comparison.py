from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import InputError, MissingDependencyError, ReferenceFormatError
from onthefly3r.evaluate import icp
from onthefly3r.evaluate.clouds import open_cloud
from onthefly3r.evaluate.comparison import evaluate, format_table
from onthefly3r.evaluate.readers import read_poses, scene_depth
from onthefly3r.evaluate.surface import ground_difference
from onthefly3r.evaluate.trajectory_errors import pose_errors
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.products.colmap import write_model
from onthefly3r.products.las import write_cloud
from onthefly3r.products.rows import placed_row
from onthefly3r.products.trajectory_table import write_trajectory
from onthefly3r.records import CloudTile, PlacedCamera, Shot

CAMERA = Camera(1600, 900, 950.0, 950.0, 800.0, 450.0)
DOWN = np.diag([1.0, -1.0, -1.0])


def surface(n: int = 6_000, seed: int = 0) -> np.ndarray:
    xy = np.random.default_rng(seed).uniform(0, 60, (n, 2))
    return np.column_stack([xy, 3 * np.sin(xy[:, 0] / 8) + 2 * np.cos(xy[:, 1] / 5)])


def write_run(folder: Path, frame: Sim3, points: np.ndarray) -> Path:
    """An output folder of a run whose truth is moved by `frame`."""
    names = [f"DJI_{k}.JPG" for k in range(12)]
    placed = []
    for k, name in enumerate(names):
        truth = Rigid3(DOWN, np.array([10.0 * (k % 4), 20.0 * (k // 4), 50.0 + k % 3]))
        placed.append(PlacedCamera(k, name, CAMERA, frame.apply_to_pose(truth), 0))
    shots = [Shot(name, Path(name), 1600, 900, "cam", 0.6, 0.05, "guess") for name in names]
    write_trajectory(folder / "trajectory.csv", [placed_row(c, s) for c, s in zip(placed, shots, strict=True)])
    write_model(folder / "colmap", placed)
    n = len(points)
    zeros = np.zeros(n, np.int32)
    tile = CloudTile(frame.apply(points), np.zeros((n, 3), np.uint8), np.ones(n, np.float32), zeros, zeros, zeros + 1)
    write_cloud(folder / "cloud.laz", iter([tile]), None, 1e-4)
    return folder


def test_poses_and_cloud_of_a_run(tmp_path: Path) -> None:
    truth = write_run(tmp_path / "truth", Sim3(), surface())
    (tmp_path / "truth" / "colmap" / "summary.json").write_text('{"median_scene_depth": 50.0}')
    shifted = Sim3(1.0, np.eye(3), np.array([0.0, 0.0, 0.5]))
    run = write_run(tmp_path / "run", shifted, surface())
    (run / "report.json").write_text('{"images": {"given": 16}}')
    report = evaluate(run, truth / "colmap", truth, align="none", ground_cell_m=2.0)
    values = report.to_dict()
    json.dumps(values, allow_nan=False)
    assert values["poses"]["ate"] == pytest.approx(0.5, abs=1e-5)
    assert values["poses"]["ate_percent_of_depth"] == pytest.approx(1.0, abs=1e-4)
    assert values["poses"]["placed_of_given"] == 0.75
    assert values["ground"]["difference_m"] == pytest.approx(0.5, abs=0.01)
    assert 0.2 < values["cloud"]["chamfer_m"] <= 0.5
    table = format_table(report)
    assert "1.000 % of flying height" in table
    assert "0.750" in table


def test_a_cloud_in_another_frame_follows_its_cameras(tmp_path: Path) -> None:
    truth = write_run(tmp_path / "truth", Sim3(), surface())
    frame = Sim3(0.2, rotation_exp(np.array([0.4, 1.0, -0.5])), np.array([3.0, -2.0, 1.0]))
    run = write_run(tmp_path / "run", frame, surface())
    report = evaluate(run, truth / "colmap", truth / "cloud.laz", cloud_align="poses")
    assert report.surface is not None
    assert report.surface.chamfer < 1e-3  # coordinates are kept to 0.1 mm of the small frame
    assert report.poses is not None
    assert report.poses.ate < 1e-4


def test_common_frames_are_added(tmp_path: Path) -> None:
    truth = write_run(tmp_path / "truth", Sim3(), surface())
    other = tmp_path / "other.csv"
    lines = (truth / "trajectory.csv").read_text().splitlines()
    other.write_text("\n".join(lines[:8]) + "\n")
    report = evaluate(truth, truth / "colmap", common_with=[other])
    assert report.poses is not None
    assert report.common is not None
    assert (report.poses.n_common, report.common.n_common) == (12, 7)
    assert "common frames (7 of" in format_table(report)


def test_questions_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to compare"):
        evaluate(tmp_path)
    with pytest.raises(InputError, match="needs reference poses"):
        evaluate(tmp_path, None, tmp_path, cloud_align="poses")


def test_without_open3d_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        icp.import_open3d()


@pytest.mark.usefixtures("open3d")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_icp_finds_a_small_motion(tmp_path: Path) -> None:
    motion = Sim3(1.0, rotation_exp(np.radians([0.5, -0.4, 0.8])), np.array([0.4, -0.3, 0.6]))
    truth = write_run(tmp_path / "truth", Sim3(), surface(20_000, seed=1))
    run = write_run(tmp_path / "run", motion, surface(20_000, seed=2))
    before, after = evaluate(run, None, truth), evaluate(run, None, truth, icp=True)
    assert before.surface is not None
    assert after.surface is not None
    assert after.surface.chamfer < 0.6 * before.surface.chamfer
    found = after.icp_from_result
    assert found is not None
    left = (found @ motion).apply(surface())
    assert np.abs(left - surface()).max() < 0.05


@pytest.mark.usefixtures("open3d")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_icp_refuses_clouds_that_are_far_apart(tmp_path: Path) -> None:
    truth = write_run(tmp_path / "truth", Sim3(), surface())
    run = write_run(tmp_path / "run", Sim3(1.0, np.eye(3), np.array([500.0, 0, 0])), surface())
    with pytest.raises(ReferenceFormatError, match="cannot be compared"):
        evaluate(run, None, truth, icp=True)


@pytest.mark.photographs
def test_reference_models_of_the_photographs(photograph_sets: Path) -> None:
    """Every reference is read whole; against itself turned, scaled and shifted nothing is left."""
    for folder in sorted(photograph_sets.glob("*/reference")):
        reference = read_poses(folder)
        stated = json.loads((folder / "summary.json").read_text())
        assert len(reference.names) == stated["images"]
        assert all((folder.parent / "photos" / name).is_file() for name in reference.names)
        moved = reference.moved(Sim3(9.0, rotation_exp(np.array([0.1, 2.0, 0.3])), np.array([5e5, 5e6, 100.0])))
        errors = pose_errors(moved, reference)
        assert errors.ate < 1e-6
        assert errors.are_deg < 1e-4
        assert scene_depth(folder) == stated["median_scene_depth"] > 0.0


@pytest.mark.photographs
def test_cloud_of_another_program(photograph_sets: Path) -> None:
    file = photograph_sets / "brighton_beach" / "reference" / "odm_cloud.laz"
    if not file.is_file():
        pytest.skip(f"no {file}")
    other = open_cloud(file)
    assert other.n_points == 940_393
    difference = ground_difference(other, other, 1.0, Sim3(1.0, np.eye(3), np.array([0.0, 0.0, -1.75])))
    assert difference.median == pytest.approx(-1.75)
    assert difference.n_cells > 3_000
