"""The demonstration: render a survey, reconstruct it from its photographs alone, compare with the truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..evaluate.clouds import open_cloud
from ..evaluate.poses import PoseSet, match
from ..evaluate.readers import read_trajectory_csv
from ..evaluate.trajectory_errors import pose_errors
from ..files.atomic import write_text
from ..files.owned import OwnedFolder
from ..geometry.arrays import Float
from ..geometry.geodesy import EnuFrame, WorldFrame
from ..options import Options
from ..protocol import ProgressCallback

if TYPE_CHECKING:
    from ..run.result import Result
    from ..simulate.flight import Survey, SurveyOptions

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
    are_deg: float  # fitted
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
    from ..run.session import reconstruct
    from ..simulate import simulate_survey
    from ..simulate.flight import SurveyOptions

    survey = simulate_survey(out, survey_options or SurveyOptions(), progress)
    options = Options()
    result = reconstruct(out / "photos", out / "result", options, progress, cancel)
    accuracy = compare_with_truth(result.report, out / "result", survey, options)
    with OwnedFolder.claim(out, "demo") as folder, folder.scratch() as made:
        write_text(made / "accuracy.json", json.dumps(asdict(accuracy), indent=1))
        folder.publish(made, "accuracy")
    return Demo(out, result, accuracy)


def compare_with_truth(report: dict[str, Any], folder: Path, survey: Survey, options: Options) -> Accuracy:
    """Measure the trajectory and the cloud in `folder` in the survey's east-north-up frame."""
    georeference = report["georeference"]
    origin = survey.origin
    enu = EnuFrame(origin.lat_deg, origin.lon_deg, origin.height_m)
    world = WorldFrame(georeference["crs"], georeference["vertical"], enu)
    poses = read_trajectory_csv(folder / "trajectory.csv")
    rotations = world.rotation_world_from_enu().T @ poses.rotations
    estimate = PoseSet(poses.source, poses.names, world.to_enu(poses.centres), rotations)
    names = [view.name for view in survey.views]
    truth = PoseSet.from_poses(folder, names, [view.enu_from_cam for view in survey.views])
    fitted = pose_errors(estimate, truth)
    rows, true_rows = match(estimate, truth)
    offsets = estimate.centres[rows] - truth.centres[true_rows]

    cloud = open_cloud(folder / report["cloud"]["path"])
    step = max(1, cloud.n_points // CLOUD_SAMPLE)
    points = world.to_enu(np.concatenate([chunk[::step] for chunk in cloud.chunks()]))
    cloud_fitted_m = _mean_distance(survey, fitted.reference_from_estimate.apply(points))
    camera = survey.views[0].camera
    longest_px = max(camera.width, camera.height)
    working_px = min(longest_px, options.backbone.working_px)
    gsd_m = survey.options.altitude_m / camera.fx * longest_px / working_px
    return Accuracy(
        cameras=fitted.n_common,
        ate_m=fitted.ate,
        ate_percent=100.0 * fitted.ate / survey.options.altitude_m,
        are_deg=fitted.are_deg,
        camera_absolute_h_m=_rms(offsets[:, :2]),
        camera_absolute_v_m=_rms(offsets[:, 2:]),
        cloud_points=cloud.n_points,
        cloud_absolute_m=_mean_distance(survey, points),
        cloud_fitted_m=cloud_fitted_m,
        cloud_fitted_gsd=cloud_fitted_m / gsd_m,
        gsd_m=gsd_m,
    )


def _mean_distance(survey: Survey, points: Float) -> float:
    return float(np.mean(survey.scene.distance_to_surface(points)))


def _rms(errors: Float) -> float:
    """Return the root of the mean squared length of error vectors (N, D)."""
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))))
