"""All strategies on simulated surveys of the paper's sizes, answered by the oracle: truth spoilt as stated.

One row of figures and one file of poses for each run; a run that is there already is not repeated, so that a long
command may be stopped and started again.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from onthefly3r.evaluate.poses import PoseSet
from onthefly3r.evaluate.trajectory_errors import pose_errors
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.records import Shot, WorkingImage
from onthefly3r.simulate.flight import Survey, SurveyOptions, TrueView, plan_survey
from onthefly3r.simulate.oracle import Faults, Noise, OracleBackbone, OracleDescriber, oracle_images, oracle_shots

from .results import write_result
from .strategies import Placement, Task, place


@dataclass(frozen=True)
class Scenario:
    """A simulated survey and what goes wrong in it."""

    name: str
    images: int
    strips: int
    drones: int  # that fly side by side and whose photographs arrive in turn
    look_alike: bool
    noise: Noise
    faults: Faults


GRID_SIDE_PX = 64  # longest side of the point maps: coarse, so that thousands of images take minutes
NOISE = Noise(rotation_deg=0.15, position_m=0.3, depth=0.002, log_scale=0.10, bend_m=0.3)
FAULTS = Faults(bad_view_rate=0.02, strays=True)
SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario("small", 120, 6, 2, True, NOISE, FAULTS),
        Scenario("plain", 100, 5, 1, False, NOISE, Faults()),
        Scenario("joint", 58, 5, 1, False, NOISE, replace(FAULTS, bad_view_rate=0.0)),
        Scenario("HAV-in-order", 424, 14, 1, False, NOISE, FAULTS),
        Scenario("HAV", 424, 14, 2, False, NOISE, FAULTS),
        Scenario("HAV-saddle", 424, 14, 2, False, replace(NOISE, bend_form="saddle"), FAULTS),
        Scenario("HAV-cylinder", 424, 14, 2, False, replace(NOISE, bend_form="cylinder"), FAULTS),
        Scenario("HAV-third-order", 424, 14, 2, False, replace(NOISE, bend_m=0.0, third_order_m=0.3), FAULTS),
        Scenario("HAV-repeated-errors", 424, 14, 2, False, replace(NOISE, repeated=1.0), FAULTS),
        Scenario("HAV-bad-photographs", 424, 14, 2, False, NOISE, replace(FAULTS, bad_photograph_rate=0.09)),
        Scenario("HAV-wrong-confidence", 424, 14, 2, False, replace(NOISE, confidence="inverted"), FAULTS),
        Scenario("Residence", 2582, 33, 2, True, NOISE, FAULTS),
        Scenario("Residence-plain", 2582, 33, 2, False, NOISE, FAULTS),
        Scenario("Campus", 5871, 50, 3, True, NOISE, FAULTS),
    )
}


def survey_of(scenario: Scenario, seed: int) -> Survey:
    """Plan the survey; its views stand in the order in which the photographs arrive."""
    survey = plan_survey(
        SurveyOptions(
            images=scenario.images,
            strips=scenario.strips,
            altitude_m=100.0,
            look_alike=scenario.look_alike,
            seed=seed,
        )
    )
    return replace(survey, views=in_turn(survey.views, scenario.drones))


def in_turn(views: Sequence[TrueView], drones: int) -> tuple[TrueView, ...]:
    """Let so many drones fly equal shares of a survey at the same time: one photograph of each in turn."""
    shares = [[views[k] for k in share] for share in np.array_split(np.arange(len(views)), drones)]
    longest = max(len(share) for share in shares)
    return tuple(share[k] for k in range(longest) for share in shares if k < len(share))


def run_one(scenario: Scenario, strategy: str, seed: int, out: Path) -> dict[str, Any]:
    """Run a strategy, write its poses and its row of figures, and return the row."""
    survey = survey_of(scenario, seed)
    shots = [replace(shot, gps=None, attitude=None) for shot in oracle_shots(survey)]  # images alone, as in the paper
    images = {image.shot.name: image for image in oracle_images(survey, GRID_SIDE_PX).values()}

    def load(shot: Shot) -> WorkingImage:
        return images[shot.name]

    backbone = OracleBackbone(survey, scenario.noise, scenario.faults, seed, grid_side_px=GRID_SIDE_PX)
    describer = OracleDescriber(survey, seed=seed)
    with tempfile.TemporaryDirectory() as work:
        placement = place(strategy, Task(shots, load, backbone, describer, Path(work)))
    row = {"scenario": scenario.name, "strategy": strategy, "seed": seed, **figures(placement, survey)}
    names = [view.name for view in survey.views]
    if placement.map_from_cam:
        write_result(pose_file(out, scenario.name, strategy, seed), names, placement.map_from_cam)
    rows = out / "rows.jsonl"
    with rows.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(row) + "\n")
    return row


def pose_file(out: Path, scenario: str, strategy: str, seed: int) -> Path:
    """Return where the poses of a run are kept."""
    return out / "poses" / f"{scenario}-{strategy}-{seed}.npz"


def read_rows(out: Path) -> list[dict[str, Any]]:
    """Return the rows of all runs so far."""
    path = out / "rows.jsonl"
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def run_all(names: Iterable[str], strategies: Sequence[str], seeds: Sequence[int], out: Path) -> None:
    """Run what is missing, survey after survey and seed after seed, and tell how each went."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "scenarios.json").write_text(json.dumps({k: asdict(s) for k, s in SCENARIOS.items()}, indent=1))
    done = {(row["scenario"], row["strategy"], row["seed"]) for row in read_rows(out)}
    for name in names:
        for seed in seeds:
            for strategy in strategies:
                if (name, strategy, seed) not in done:
                    row = run_one(SCENARIOS[name], strategy, seed, out)
                    ate = "-" if row["ate"] is None else f"{row['ate']:.2f} m"
                    print(
                        f"{name:<10} {strategy:<20} seed {seed}: ATE {ate}, {row['placed']}/{row['given']} placed, "
                        f"{row['seconds']:.0f} s {row['note']}",
                        flush=True,
                    )


def figures(placement: Placement, survey: Survey) -> dict[str, Any]:
    """Return the errors of a placement against the truth (metres, degrees), its coverage and its price."""
    row: dict[str, Any] = {
        "given": len(survey.views),
        "placed": len(placement.map_from_cam),
        "calls": placement.calls,
        "inferred": placement.inferred,
        "largest": placement.largest,
        "seconds": placement.seconds,
        "note": placement.note,
        "ate": None,
        "are_deg": None,
        "rte_deg": None,
        "rre_deg": None,
        "passes": [[ate(p.before, survey), ate(p.after, survey)] for p in placement.passes],
    }
    if placement.map_from_cam:
        errors = pose_errors(pose_set(placement.map_from_cam, survey), truth(survey))
        row |= {"ate": errors.ate, "are_deg": errors.are_deg, "rte_deg": errors.rte_deg, "rre_deg": errors.rre_deg}
    return row


def ate(map_from_cam: Mapping[int, Rigid3], survey: Survey) -> float:
    """Return the ATE of some poses in metres."""
    return pose_errors(pose_set(map_from_cam, survey), truth(survey)).ate


def pose_set(map_from_cam: Mapping[int, Rigid3], survey: Survey) -> PoseSet:
    """Return poses in capture order, which the names follow."""
    placed = sorted(map_from_cam, key=lambda i: survey.views[i].name)
    return PoseSet.from_poses(Path("result"), [survey.views[i].name for i in placed], [map_from_cam[i] for i in placed])


def truth(survey: Survey) -> PoseSet:
    """Return the true poses in capture order."""
    return pose_set({i: view.enu_from_cam for i, view in enumerate(survey.views)}, survey)
