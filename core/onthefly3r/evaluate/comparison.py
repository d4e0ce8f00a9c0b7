"""Everything `onthefly3r evaluate` prints: pose errors and cloud errors of one result against references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..errors import InputError
from ..files.strict_json import loads
from ..geometry.transforms import Sim3
from .clouds import open_cloud
from .readers import read_poses, scene_depth
from .same_frame import in_frame_of
from .surface import GroundDifference, SurfaceErrors, ground_difference, surface_errors
from .trajectory_errors import Align, PoseErrors, pose_errors

CloudAlign = Literal["none", "poses"]


@dataclass(frozen=True)
class EvaluationReport:
    """What was compared and how far apart it is; parts that were not asked for are None."""

    result: Path
    poses: PoseErrors | None = None
    common: PoseErrors | None = None  # over the images that the other results hold too
    scene_depth: float | None = None  # median distance camera to ground in the unit of the reference
    images_given: int | None = None  # of the run, from its report
    surface: SurfaceErrors | None = None
    ground: GroundDifference | None = None
    icp_from_result: Sim3 | None = None  # refinement before the clouds were compared
    notes: tuple[str, ...] = ()  # what a reader must know about the comparison

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        surface, ground = self.surface, self.ground
        return {
            "result": str(self.result),
            "poses": None if self.poses is None else self._poses_dict(self.poses),
            "common_frames": None if self.common is None else self._poses_dict(self.common),
            "cloud": None
            if surface is None
            else {
                "accuracy_m": surface.accuracy,
                "completeness_m": surface.completeness,
                "chamfer_m": surface.chamfer,
                "accuracy_median_m": surface.accuracy_median,
                "completeness_median_m": surface.completeness_median,
                "n_result": surface.n_result,
                "n_reference": surface.n_reference,
            },
            "ground": None
            if ground is None
            else {
                "difference_m": ground.median,
                "nmad_m": ground.nmad,
                "n_cells": ground.n_cells,
                "cell_m": ground.cell,
            },
            "notes": list(self.notes),
            "icp": None if self.icp_from_result is None else self.icp_from_result.matrix().tolist(),
        }

    def _poses_dict(self, errors: PoseErrors) -> dict[str, Any]:
        return {
            "n_common": errors.n_common,
            "n_reference": errors.n_reference,
            "coverage": errors.coverage,
            "placed_of_given": errors.n_estimate / self.images_given if self.images_given else None,
            "ate": errors.ate,
            "ate_percent_of_depth": 100.0 * errors.ate / self.scene_depth if self.scene_depth else None,
            "are_deg": errors.are_deg,
            "rte_deg": errors.rte_deg,
            "rre_deg": errors.rre_deg,
            "scale": errors.reference_from_estimate.scale,
        }


def evaluate(
    result: Path,
    reference_poses: Path | None = None,
    reference_cloud: Path | None = None,
    *,
    align: Align = "sim3",
    common_with: Sequence[Path] = (),
    cloud_align: CloudAlign = "none",
    icp: bool = False,
    ground_cell_m: float | None = None,
) -> EvaluationReport:
    """Compare a result with reference poses, a reference cloud or both.

    Args:
        result: output folder of a run, or a file of poses (with `reference_poses`) or points (with `reference_cloud`).
        reference_poses: see `readers.read_poses`; a summary.json beside it with `median_scene_depth` gives the
            position error in per cent of the flying height too.
        reference_cloud: .las, .laz or .ply, or an output folder.
        align: fitted to the camera centres before poses are compared.
        common_with: further results; pose errors over the images that all hold are added.
        cloud_align: `none` compares clouds as they lie, after a transformation where they state different coordinate
            systems or height references; `poses` moves the result by the fit of the cameras.
        icp: refines that by rigid ICP (needs open3d) before clouds are compared.
        ground_cell_m: also compares heights over a horizontal grid of this cell.

    Raises:
        InputError: nothing to compare with, or one of its children for a file or package.
    """
    if reference_poses is None and reference_cloud is None:
        raise InputError("nothing to compare with; give reference poses, a reference cloud or both")
    if cloud_align == "poses" and reference_poses is None:
        raise InputError("aligning the cloud by the cameras needs reference poses")
    poses = common = depth = surface = ground = refinement = None
    notes: tuple[str, ...] = ()
    if reference_poses is not None:
        found, reference = read_poses(result), read_poses(reference_poses)
        poses, depth = pose_errors(found, reference, align), scene_depth(reference_poses)
        if common_with:
            common = pose_errors(found, reference, align, [read_poses(path) for path in common_with])
    if reference_cloud is not None:
        cloud, reference_points = open_cloud(result), open_cloud(reference_cloud)
        if cloud_align == "poses" and poses:
            move = poses.reference_from_estimate
        else:
            move = Sim3()
            reference_points, notes = in_frame_of(cloud, reference_points)
        if icp:
            from .icp import refine

            refinement = refine(cloud, reference_points, move)
            move = refinement @ move
        surface = surface_errors(cloud, reference_points, move)
        if ground_cell_m is not None:
            ground = ground_difference(cloud, reference_points, ground_cell_m, move)
    return EvaluationReport(result, poses, common, depth, _images_given(result), surface, ground, refinement, notes)


def format_table(report: EvaluationReport) -> str:
    """Return the report as a plain text table."""
    values = report.to_dict()
    lines = [f"{report.result}"]
    for title, key in (("cameras", "poses"), ("cameras, common frames", "common_frames")):
        if values[key] is not None:
            lines += _pose_lines(title, values[key])
    cloud, ground = values["cloud"], values["ground"]
    if cloud is not None:
        lines.append(f"cloud ({cloud['n_result']:,} points against {cloud['n_reference']:,})")
        lines += [
            _line("Acc.", f"{cloud['accuracy_m']:.4f}", f"median {cloud['accuracy_median_m']:.4f}"),
            _line("Comp.", f"{cloud['completeness_m']:.4f}", f"median {cloud['completeness_median_m']:.4f}"),
            _line("CD", f"{cloud['chamfer_m']:.4f}"),
        ]
    if ground is not None:
        note = f"NMAD {ground['nmad_m']:.3f}, {ground['n_cells']:,} cells of {ground['cell_m']:g}"
        lines.append(_line("height", f"{ground['difference_m']:+.3f}", note))
    lines += [f"note: {note}" for note in report.notes]
    return "\n".join(lines)


def _pose_lines(title: str, poses: dict[str, Any]) -> list[str]:
    lines = [
        f"{title} ({poses['n_common']} of the reference's {poses['n_reference']} images)",
        _line("coverage", f"{poses['coverage']:.3f}"),
    ]
    if poses["placed_of_given"] is not None:
        lines.append(_line("placed", f"{poses['placed_of_given']:.3f}", "of the photographs given"))
    percent = poses["ate_percent_of_depth"]
    note = "" if percent is None else f"{percent:.3f} % of flying height"
    lines.append(_line("ATE", f"{poses['ate']:.5g}", note))
    for name in ("are", "rte", "rre"):
        value = poses[f"{name}_deg"]
        lines.append(_line(name.upper(), "-" if value is None else f"{value:.4f}", "deg"))
    return lines


def _line(name: str, value: str, note: str = "") -> str:
    return f"  {name:<9} {value:>10}  {note}".rstrip()


def _images_given(result: Path) -> int | None:
    report = result / "report.json"
    if not report.is_file():
        return None
    try:
        given = loads(report.read_text(encoding="utf-8"))["images"]["given"]
    except (ValueError, KeyError, TypeError):
        return None  # not a report of ours: the figure is only extra
    return given if isinstance(given, int) else None
