"""All strategies with the classical backbone on real photographs, in capture order and shuffled."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from onthefly3r.backbones.registry import create_backbone
from onthefly3r.evaluate.poses import PoseSet, match
from onthefly3r.evaluate.readers import read_poses, scene_depth
from onthefly3r.evaluate.trajectory_errors import pose_errors
from onthefly3r.features.extraction import FeatureStore
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.intake.folder import read_photographs
from onthefly3r.intake.images import load_working_image
from onthefly3r.options import Options
from onthefly3r.selection.describer import create_describer

from .results import write_result
from .simulated import pose_file, read_rows
from .strategies import Placement, Task, place

ORDERS = ("capture order", "shuffled")
MIN_CAMERAS = 3  # that a similarity needs


def run_one(folder: Path, order: str, strategy: str, seed: int, out: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Run a strategy on a set (photos/, reference/); write its poses and its row, and return the row.

    Positions in the tags are not shown to any strategy: images alone decide, as in the paper.
    """
    options = Options.from_flat(given)
    intake = Options.from_flat({**given, "shuffle_seed": seed if order == "shuffled" else None}).intake
    found, _ = read_photographs(folder / "photos", intake)
    shots = [replace(shot, gps=None, attitude=None) for shot in found]
    with tempfile.TemporaryDirectory() as work:
        features = FeatureStore(Path(work) / "features", options.backbone.features)
        task = Task(
            shots=shots,
            load=lambda shot: load_working_image(shot, options.backbone.working_px),
            backbone=create_backbone(options.backbone, features),
            describer=create_describer(options.selection, features, options.backbone.device),
            work=Path(work) / "map",
            options=given,
        )
        placement = place(strategy, task)
    names = [shot.name for shot in shots]
    row = {"set": folder.name, "order": order, "strategy": strategy, "seed": seed}
    row |= figures(placement, names, folder / "reference")
    if placement.map_from_cam:
        path = pose_file(out, folder.name, f"{strategy}-{order.replace(' ', '-')}", seed)
        write_result(path, names, placement.map_from_cam)
    with (out / "rows.jsonl").open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(row) + "\n")
    return row


def figures(placement: Placement, names: Sequence[str], reference_folder: Path) -> dict[str, Any]:
    """Return the errors against reference poses (ATE in per cent of the flying height, degrees), coverage and price."""
    reference, depth = read_poses(reference_folder), scene_depth(reference_folder)
    row: dict[str, Any] = {
        "given": len(names),
        "placed": len(placement.map_from_cam),
        "calls": placement.calls,
        "inferred": placement.inferred,
        "largest": placement.largest,
        "seconds": placement.seconds,
        "note": placement.note,
        "ate_percent": None,
        "passes": [],
    }
    if len(placement.map_from_cam) >= MIN_CAMERAS:
        errors = pose_errors(_pose_set(placement.map_from_cam, names, reference), reference)
        row |= {"are_deg": errors.are_deg, "rte_deg": errors.rte_deg, "rre_deg": errors.rre_deg}
        row["ate_percent"] = 100.0 * errors.ate / depth if depth else None
        for graph_pass in placement.passes:
            sets = (_pose_set(poses, names, reference) for poses in (graph_pass.before, graph_pass.after))
            row["passes"].append([pose_errors(poses, reference).ate for poses in sets])
    return row


def run_all(
    folders: Sequence[Path],
    orders: Sequence[str],
    strategies: Sequence[str],
    seed: int,
    out: Path,
    given: dict[str, Any],
) -> None:
    """Run what is missing, and tell how each went."""
    out.mkdir(parents=True, exist_ok=True)
    done = {(row["set"], row["order"], row["strategy"], row["seed"]) for row in read_rows(out)}
    for folder in folders:
        for order in orders:
            for strategy in strategies:
                if (folder.name, order, strategy, seed) not in done:
                    row = run_one(folder, order, strategy, seed, out, given)
                    ate = "-" if row["ate_percent"] is None else f"{row['ate_percent']:.2f} %"
                    print(
                        f"{folder.name:<16} {order:<14} {strategy:<20}: ATE {ate} of the flying height, "
                        f"{row['placed']}/{row['given']} placed, {row['seconds']:.0f} s {row['note']}",
                        flush=True,
                    )


def _pose_set(map_from_cam: Mapping[int, Rigid3], names: Sequence[str], reference: PoseSet) -> PoseSet:
    """Return poses in the order of the reference, whose names follow the capture."""
    placed = list(map_from_cam)
    poses = PoseSet.from_poses(reference.source, [names[i] for i in placed], [map_from_cam[i] for i in placed])
    rows, reference_rows = match(poses, reference)
    return poses.take(rows[reference_rows.argsort()])
