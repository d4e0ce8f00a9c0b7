"""Whole runs on real photographs against full bundle adjustments of the same photographs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r import Options, reconstruct
from onthefly3r.errors import GeoreferenceError
from onthefly3r.evaluate.comparison import EvaluationReport, evaluate
from onthefly3r.evaluate.readers import read_poses, read_trajectory_csv
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.run.export import export

pytestmark = pytest.mark.photographs

# Required against the reference: share of its images, error in % of the flying height, error of the angles. Where the
# photographs tell the principal point, the reference has it free too: held in the middle it is 2.2 % off on caliterra.
COVERAGE, ATE_PERCENT, ARE_DEG = 0.95, 0.7, 0.5
WITH_FREE_POINT = {"caliterra": 0.10}  # set -> largest error in %
CAMERAS_ONLY = {"dense_px": 100, "cloud": False, "rasters": False, "orthophoto": "none"}


def run(sets: Path, name: str, out: Path, **options: Any) -> EvaluationReport:
    reconstruct(sets / name / "photos", out, Options.from_flat(options))
    return evaluate(out, sets / name / ("reference_pp/free" if name in WITH_FREE_POINT else "reference"))


def flying_height(folder: Path) -> float:
    """The median scene depth of the reference, in the unit of the model that a result is compared with."""
    depth = json.loads((folder / "reference" / "summary.json").read_text(encoding="utf-8"))["median_scene_depth"]
    if folder.name not in WITH_FREE_POINT:
        return float(depth)
    models = [read_poses(folder / model) for model in ("reference", "reference_pp/free")]
    centres = [dict(zip(model.names, model.centres, strict=True)) for model in models]
    common = sorted(set(centres[0]) & set(centres[1]))
    source, target = (np.array([of[name] for name in common]) for of in centres)
    return float(depth * weighted_similarity(source, target, np.ones(len(common))).scale)


def require(sets: Path, name: str, report: EvaluationReport) -> None:
    assert report.poses is not None
    assert report.poses.coverage >= COVERAGE
    assert 100.0 * report.poses.ate / flying_height(sets / name) <= WITH_FREE_POINT.get(name, ATE_PERCENT)
    assert report.poses.are_deg <= ARE_DEG


def test_brighton_beach(photograph_sets: Path, tmp_path: Path) -> None:
    """The ground lies where the drone's barometer says: 158.5 m is its height less that above the take-off."""
    import laspy

    require(photograph_sets, "brighton_beach", run(photograph_sets, "brighton_beach", tmp_path))
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert (report["georeference"]["crs"], report["georeference"]["vertical"]) == ("EPSG:32615", "egm96")
    assert report["georeference"]["rmse_h_m"] < 1.0
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert len(cloud) > 200_000
    assert abs(np.median(cloud.z) - 158.5) < 2.0


@pytest.mark.parametrize("name", ["brighton_beach", "caliterra"])
def test_shuffled_photographs(photograph_sets: Path, tmp_path: Path, name: str) -> None:
    require(photograph_sets, name, run(photograph_sets, name, tmp_path, shuffle_seed=3, **CAMERAS_ONLY))


def test_caliterra_is_level_although_its_heights_drift(photograph_sets: Path, tmp_path: Path) -> None:
    """Its camera axes stay within ten degrees of the nadir on average, where a plain fit tilts them by 45."""
    require(photograph_sets, "caliterra", run(photograph_sets, "caliterra", tmp_path, **CAMERAS_ONLY))
    axes = read_trajectory_csv(tmp_path / "trajectory.csv").rotations[:, :, 2]
    mean = axes.mean(axis=0)
    assert np.degrees(np.arccos(-mean[2] / np.linalg.norm(mean))) < 10.0


def test_sheffield_cross(photograph_sets: Path, tmp_path: Path) -> None:
    require(photograph_sets, "sheffield_cross", run(photograph_sets, "sheffield_cross", tmp_path, **CAMERAS_ONLY))


def test_copr_has_no_positions(photograph_sets: Path, tmp_path: Path) -> None:
    """The report says so; asked for, the files are written in units of the map."""
    with pytest.raises(GeoreferenceError, match="--local"):
        reconstruct(photograph_sets / "copr" / "photos", tmp_path / "run", Options.from_flat({"dense_px": 200}))
    local = export(
        tmp_path / "run",
        tmp_path / "local",
        Options.from_flat({"local": True, "quality": "preview", "orthophoto": "none"}),
    )
    assert local.cloud is not None and local.report["cloud"]["points"] > 10_000
    reference = read_poses(photograph_sets / "copr" / "reference")
    assert len(set(reference.names) & set(read_poses(tmp_path / "local").names)) >= COVERAGE * len(reference.names)
