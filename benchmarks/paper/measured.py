"""What a program's results on the paper's scenes are worth: errors, coverage, time and memory, scene by scene.

Results lie in RESULTS/METHOD/: for each scene the poses (SCENE.npz, SCENE.txt in TUM form, or a folder SCENE that
holds a COLMAP model or a run of ours), where there is one the cloud (SCENE.ply, .las or .laz, or in that folder), and
what the program took (SCENE.json: `seconds`, `peak_gpu_gb`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from onthefly3r.errors import InputError, ReferenceFormatError
from onthefly3r.evaluate.clouds import open_cloud
from onthefly3r.evaluate.poses import PoseSet, match
from onthefly3r.evaluate.surface import SurfaceErrors, surface_errors
from onthefly3r.evaluate.trajectory_errors import PoseErrors, pose_errors
from onthefly3r.geometry.transforms import Rigid3

from .datasets import Scene
from .results import read_result

POSE_SUFFIXES = (".npz", ".txt", ".tum", ".csv", "")
BYTES_PER_MIB = 2**20
CLOUD_SUFFIXES = (".ply", ".laz", ".las", "")
OURS = "On-the-Fly3R (Pi3x)"  # whose accepted frames are the common set, as in the paper


@dataclass(frozen=True)
class SceneResult:
    """One method in one scene; None where it left nothing or the reference has no cloud."""

    given: int
    placed: int  # images with a pose, whether the reference has one or not
    errors: PoseErrors | None = None
    common: PoseErrors | None = None  # over the frames that `common_with` accepted
    surface: SurfaceErrors | None = None
    seconds: float | None = None
    peak_gpu_gb: float | None = None


def measure(folder: Path, scene: Scene, common_with: Path | None = None) -> SceneResult:
    """Compare what a method left in its folder with the reference of a scene.

    Args:
        folder: RESULTS/METHOD.
        scene: of the data set.
        common_with: folder of the method whose accepted frames are the common set.

    Raises:
        ReferenceFormatError: a file is there but cannot be read, or matches no image of the scene.
    """
    estimate = _poses(folder, scene)
    seconds, peak_gpu_gb = _price(folder / f"{scene.name}.json", folder / scene.name / "report.json")
    if estimate is None:
        return SceneResult(len(scene.images), 0, seconds=seconds, peak_gpu_gb=peak_gpu_gb)
    errors = pose_errors(estimate, scene.reference)
    accepted = _poses(common_with, scene) if common_with is not None else None
    cloud = _beside(folder, scene.name, CLOUD_SUFFIXES)
    surface = None
    if scene.cloud is not None and cloud is not None and _has_cloud(cloud):
        surface = surface_errors(open_cloud(cloud), open_cloud(scene.cloud), errors.reference_from_estimate)
    return SceneResult(
        given=len(scene.images),
        placed=len(estimate.names),
        errors=errors,
        common=pose_errors(estimate, scene.reference, only=[accepted]) if accepted is not None else None,
        surface=surface,
        seconds=seconds,
        peak_gpu_gb=peak_gpu_gb,
    )


def measure_all(results: Path, scenes: Mapping[str, Scene], common: str = OURS) -> dict[str, dict[str, SceneResult]]:
    """Return the results of every method that has a folder in `results`, by method and scene.

    Raises `InputError` when there is no such folder, and what `measure` raises.
    """
    methods = sorted(path.name for path in results.iterdir() if path.is_dir()) if results.is_dir() else []
    if not methods:
        raise InputError(f"{results}: holds no folder of a method")
    shared = results / common if common in methods else None
    return {
        method: {name: measure(results / method, scene, shared) for name, scene in scenes.items()} for method in methods
    }


def _poses(folder: Path, scene: Scene) -> PoseSet | None:
    """Return the poses in capture order, because consecutive images are compared."""
    path = _beside(folder, scene.name, POSE_SUFFIXES)
    if path is None:
        return None
    estimate = read_result(path, scene.names)
    order = PoseSet.from_poses(path, scene.names, [Rigid3()] * len(scene.names))
    rows, positions = match(estimate, order)
    return estimate.take(rows[positions.argsort()])


def _beside(folder: Path, scene: str, suffixes: tuple[str, ...]) -> Path | None:
    return next((p for s in suffixes if (p := folder / f"{scene}{s}").exists()), None)


def _has_cloud(path: Path) -> bool:
    return path.is_file() or any((path / f"cloud.{suffix}").is_file() for suffix in ("laz", "las"))


def _price(*paths: Path) -> tuple[float | None, float | None]:
    """Return (seconds, peak GPU memory in GB) from the first of these files that is there; one may be our report."""
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return None, None
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if path.name == "report.json":
            used = [stage.get("peak_gpu_mib", 0.0) for stage in told["memory"]["stages"].values()]
            seconds, peak = told["timing"]["total_s"], max(used, default=0.0) * BYTES_PER_MIB / 1e9 or None
        else:
            seconds, peak = told.get("seconds"), told.get("peak_gpu_gb")
        return (None if seconds is None else float(seconds)), (None if peak is None else float(peak))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ReferenceFormatError(f"{path}: expected seconds and peak_gpu_gb ({error!r})") from None
