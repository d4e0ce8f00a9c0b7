"""The demonstration: render a survey, reconstruct it from its photographs alone, compare with the truth."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import InputError
from .geometry.arrays import Float
from .geometry.geodesy import EnuFrame, WorldFrame
from .geometry.transforms import Sim3
from .geometry.umeyama import weighted_similarity
from .options import Options
from .protocol import ProgressCallback

if TYPE_CHECKING:
    from .engine import Result
    from .simulate.flight import Survey, SurveyOptions

CLOUD_SAMPLE = 20_000


@dataclass(frozen=True)
class Accuracy:
    """How far a reconstruction is from the truth of a simulated survey; camera figures are RMS, cloud figures means.

    "absolute" compares the files as they are; "fitted" after the similarity that fits the camera centres best,
    which leaves out what the positions in the tags were off by.
    """

    cameras: int
    ate_m: float  # fitted
    ate_percent: float  # of the flying height
    camera_absolute_h_m: float
    camera_absolute_v_m: float
    cloud_points: int  # of which a sample was measured
    cloud_absolute_m: float
    cloud_fitted_m: float
    cloud_fitted_gsd: float  # in ground sampling distances of the working images
    gsd_m: float


@dataclass(frozen=True)
class Demo:
    """What the demonstration made."""

    out: Path
    result: Result
    accuracy: Accuracy


def run_demo(
    out: Path,
    progress: ProgressCallback | None = None,
    cancel: Callable[[], bool] | None = None,
    survey_options: SurveyOptions | None = None,
) -> Demo:
    """Render a survey into out/photos, reconstruct it into out/result and measure it; also writes out/accuracy.json.

    Raises `InputError` when `out` holds something else, and what `reconstruct` raises.
    """
    from .engine import reconstruct
    from .simulate import simulate_survey
    from .simulate.flight import SurveyOptions

    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / "truth" / "origin.json").exists())):
        raise InputError(f"{out} exists and is not an earlier demonstration: name a new folder")
    survey = simulate_survey(out, survey_options or SurveyOptions(), progress)
    options = Options()
    result = reconstruct(out / "photos", out / "result", options, progress, cancel)
    accuracy = compare_with_truth(result.report, out / "result", survey, options)
    part = out / "accuracy.json.part"
    part.write_text(json.dumps(asdict(accuracy), indent=1), encoding="utf-8")
    part.replace(out / "accuracy.json")
    return Demo(out, result, accuracy)


def compare_with_truth(report: dict[str, Any], folder: Path, survey: Survey, options: Options) -> Accuracy:
    """Measure the trajectory and the cloud in `folder` in the survey's east-north-up frame."""
    georeference = report["georeference"]
    origin = survey.origin
    world = WorldFrame(
        georeference["crs"], georeference["vertical"], EnuFrame(origin.lat_deg, origin.lon_deg, origin.height_m)
    )
    true_centres = {view.name: view.enu_from_cam.translation for view in survey.views}
    placed = _placed_centres(folder / "trajectory.csv")
    names = sorted(placed.keys() & true_centres.keys())
    estimated = world.to_enu(np.array([placed[name] for name in names]))
    true = np.array([true_centres[name] for name in names])
    true_from_estimated = weighted_similarity(estimated, true, np.ones(len(names)))
    ate_m = _rms(true_from_estimated.apply(estimated) - true)

    points, n_points = _sample_cloud(folder / report["cloud"]["path"])
    points = world.to_enu(points)
    fitted_m = _mean_distance(survey, points, true_from_estimated)
    camera = survey.views[0].camera
    longest_px = max(camera.width, camera.height)
    working_px = min(longest_px, options.backbone.working_px)
    gsd_m = survey.options.altitude_m / camera.fx * longest_px / working_px
    return Accuracy(
        cameras=len(names),
        ate_m=ate_m,
        ate_percent=100.0 * ate_m / survey.options.altitude_m,
        camera_absolute_h_m=_rms((estimated - true)[:, :2]),
        camera_absolute_v_m=_rms((estimated - true)[:, 2:]),
        cloud_points=n_points,
        cloud_absolute_m=_mean_distance(survey, points, Sim3()),
        cloud_fitted_m=fitted_m,
        cloud_fitted_gsd=fitted_m / gsd_m,
        gsd_m=gsd_m,
    )


def _placed_centres(trajectory: Path) -> dict[str, tuple[float, float, float]]:
    with trajectory.open(encoding="utf-8", newline="") as stream:
        return {
            row["image"]: (float(row["x"]), float(row["y"]), float(row["z"]))
            for row in csv.DictReader(stream)
            if row["x"]
        }


def _sample_cloud(path: Path) -> tuple[Float, int]:
    """Return evenly picked points (N, 3) of a LAS or LAZ file, and how many it holds."""
    import laspy

    with laspy.open(path) as reader:
        total = int(reader.header.point_count)
        step = max(1, total // CLOUD_SAMPLE)
        chunks = [np.column_stack([chunk.x, chunk.y, chunk.z])[::step] for chunk in reader.chunk_iterator(1000 * step)]
    return np.concatenate(chunks), total


def _mean_distance(survey: Survey, points: Float, true_from_points: Sim3) -> float:
    return float(np.mean(survey.scene.distance_to_surface(true_from_points.apply(points))))


def _rms(errors: Float) -> float:
    """Return the root of the mean squared length of error vectors (N, D)."""
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))))
