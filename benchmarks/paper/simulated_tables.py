"""The figures of simulated runs and of real photographs as tables: mean over the seeds, and their range."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from onthefly3r.evaluate.poses import PoseSet
from onthefly3r.evaluate.trajectory_errors import pose_errors

from .published import ABLATION
from .results import read_result
from .simulated import SCENARIOS, pose_file, survey_of, truth
from .strategies import STRATEGIES
from .tables import markdown, shown

OURS = "on-the-fly"
CASES = {(OURS if number == 5 else f"case-{number}"): case for number, case in ABLATION.items()}


def strategies_table(rows: Sequence[dict[str, Any]], out: Path, scenario: str) -> str:
    """Return one line for each strategy that was run on a survey.

    "Median" is that of the position errors, which a few bad views do not move; "common" is the ATE on the frames that
    ours placed; "passes" is the worst ratio of the ATE after a pass of the pose graph to the one before it, over all
    passes of all seeds.
    """
    lines = []
    for strategy in STRATEGIES:
        runs = sorted(
            (r for r in rows if r["scenario"] == scenario and r["strategy"] == strategy), key=lambda r: r["seed"]
        )
        if not runs or strategy.startswith("case-"):
            continue
        poses = [_poses(out, scenario, strategy, r["seed"]) for r in runs]
        ratios = [after / before for r in runs for before, after in r["passes"] if before > 0.0]
        lines.append(
            [
                strategy,
                ", ".join(str(r["seed"]) for r in runs),
                spread([r["ate"] for r in runs], runs[0]["note"]),
                spread([_median_error(scenario, r["seed"], p) for r, p in zip(runs, poses, strict=True)]),
                spread([_common_ate(out, scenario, r["seed"], p) for r, p in zip(runs, poses, strict=True)]),
                *(spread([r[key] for r in runs]) for key in ("are_deg", "rte_deg", "rre_deg")),
                f"{100.0 * sum(r['placed'] for r in runs) / sum(r['given'] for r in runs):.2f}",
                f"{sum(r['calls'] for r in runs) / len(runs):.0f}",
                f"{sum(r['inferred'] for r in runs) / sum(r['given'] for r in runs):.2f}",
                str(max(r["largest"] for r in runs)),
                f"{max(ratios):.3f} ({len(ratios)})" if ratios else "-",
            ]
        )
    head = ["Strategy", "Seeds", "ATE m", "Median m", "Common m", "ARE deg", "RTE deg", "RRE deg", "Coverage %"]
    return markdown([*head, "Calls", "Inferred / image", "Largest call", "Passes: worst ratio"], lines)


def _runs(rows: Sequence[dict[str, Any]], scenario: str, strategy: str) -> list[dict[str, Any]]:
    """Return the rows of a strategy on a survey by seed."""
    return sorted((r for r in rows if r["scenario"] == scenario and r["strategy"] == strategy), key=lambda r: r["seed"])


def ablation_table(rows: Sequence[dict[str, Any]], scenario: str) -> str:
    """Return tab:ablation on a simulated survey; in brackets the paper's value for HAV or Residence."""
    lines = []
    for name, case in CASES.items():
        runs = _runs(rows, scenario, name)
        if not runs:
            continue
        told = {"HAV": case.hav, "Residence": case.residence}.get(scenario, (None,) * 4)
        switches = (case.dynamic_batching, case.validation_and_retry, case.pose_graph)
        keys = ("ate", "are_deg", "rte_deg", "rre_deg")
        lines.append(
            [
                "5" if name == OURS else name.removeprefix("case-"),
                *("yes" if on else "no" for on in switches),
                *(f"{spread([r[key] for r in runs])} ({shown(t)})" for key, t in zip(keys, told, strict=True)),
                f"{100.0 * sum(r['placed'] for r in runs) / sum(r['given'] for r in runs):.2f}",
                ", ".join(str(r["seed"]) for r in runs),
            ]
        )
    head = ["Case", "Dyn.", "V&R", "PGO", "ATE m", "ARE deg", "RTE deg", "RRE deg", "Coverage %", "Seeds"]
    return markdown(head, lines)


def spread(values: Sequence[float | None], otherwise: str = "") -> str:
    """Return `mean [least, greatest]` of the seeds, or why there is none."""
    known = [v for v in values if v is not None]
    if not known:
        return otherwise.split(":")[0] or "-"
    middle = sum(known) / len(known)
    return shown(middle) if len(known) == 1 else f"{shown(middle)} [{shown(min(known))}, {shown(max(known))}]"


def _median_error(scenario: str, seed: int, poses: PoseSet | None) -> float | None:
    if poses is None:
        return None
    return float(np.median([error for _, error, _ in pose_errors(poses, _truth(scenario, seed)).per_image]))


def _common_ate(out: Path, scenario: str, seed: int, poses: PoseSet | None) -> float | None:
    ours = _poses(out, scenario, OURS, seed)
    return pose_errors(poses, _truth(scenario, seed), only=[ours]).ate if poses and ours else None


def _poses(out: Path, scenario: str, strategy: str, seed: int) -> PoseSet | None:
    path = pose_file(out, scenario, strategy, seed)
    return read_result(path) if path.is_file() else None


@lru_cache(maxsize=8)
def _truth(scenario: str, seed: int) -> PoseSet:
    return truth(survey_of(SCENARIOS[scenario], seed))
