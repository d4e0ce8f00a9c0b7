"""Fragments and joins with the oracle: parts of a map that look alike stay apart, and parts that meet become one.

Two kinds of survey, each over seeds, which draw landscape, flight, noise, faults and descriptors:

- `look-alike`: two halves with a belt of bare ground between them that nobody photographed, and the same block of
  houses all over both. Nothing is shared, so every join across is a wrong one; a reconstruction that spans both lays
  block on block.
- `drones`: three drones that start 500 m apart, photograph their parts of one area at the same time, and meet.
  `drones-alike` has the same block of houses all over the area.

See README.md beside this file.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from onthefly3r.engine.loop import Engine
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.options import Options
from onthefly3r.records import Shot, WorkingImage
from onthefly3r.simulate import Survey
from onthefly3r.simulate.oracle import (
    Faults,
    OracleBackbone,
    OracleDescriber,
    oracle_images,
    oracle_shots,
    scenario,
)

GRID_PX = 96
WRONG_M = 5.0  # 5 % of the flying height: noise of the oracle moves a camera by 0.3 m
NO_POSITIONS = {"gps_candidates": False, "gps_check": False, "gps_priors": False}


def look_alike_halves(seed: int) -> Survey:
    """Return two halves of a survey of look-alike blocks, without the belt of 30 % of its strips between them."""
    survey = scenario(160, 8, seed, look_alike=True)
    north = np.array([view.enu_from_cam.translation[1] for view in survey.views])
    low, high = np.quantile(north, [0.35, 0.65])
    return replace(survey, views=tuple(v for v, y in zip(survey.views, north, strict=True) if not low <= y <= high))


def three_drones(seed: int, look_alike: bool = False) -> Survey:
    """Return 30 strips of ten photographs, flown by three drones at the same time, ten strips or 510 m each."""
    survey = scenario(300, 30, seed, look_alike=look_alike)
    flights = np.array_split(np.arange(len(survey.views)), 3)
    return replace(survey, views=tuple(survey.views[i] for at_once in zip(*flights, strict=True) for i in at_once))


SURVEYS: dict[str, Callable[[int], Survey]] = {
    "look-alike": look_alike_halves,
    "drones": three_drones,
    "drones-alike": lambda seed: three_drones(seed, look_alike=True),
}


@dataclass(frozen=True)
class Row:
    """What one run gave."""

    survey: str
    positions: bool
    seed: int
    images: int
    placed: int
    parts: list[int]  # photographs of each
    joins: int
    refused: int
    undone: int
    misplaced: int  # photographs off by more than WRONG_M after each part is fitted to the truth for itself
    worst_m: float
    cpu_s: float


def measure(survey_name: str, positions: bool, seed: int, work: Path) -> Row:
    """Run one survey one photograph after the other, without angles of the gimbal, and compare it with the truth."""
    survey = SURVEYS[survey_name](seed)
    images = {image.shot.name: image for image in oracle_images(survey, GRID_PX).values()}

    def load(shot: Shot) -> WorkingImage:
        return images[shot.name]

    options = Options.from_flat({} if positions else NO_POSITIONS)
    backbone = OracleBackbone(survey, None, Faults(strays=True), seed, grid_side_px=GRID_PX)
    engine = Engine(work, options, backbone, OracleDescriber(survey, seed=seed), load)
    began = time.process_time()
    for shot in oracle_shots(survey):
        engine.add(replace(shot, attitude=None, **({} if positions else {"gps": None})))
    engine.finish()
    cpu_s = time.process_time() - began
    parts = engine.state.fragments()
    off_m = np.concatenate([errors_m(engine, survey, frames) for frames in parts.values()])
    figures = engine.details()
    return Row(
        survey_name,
        positions,
        seed,
        len(survey.views),
        len(engine.state.frames),
        [len(frames) for frames in parts.values()],
        *(int(figures[name]) for name in ("joins", "joins_refused", "joins_undone")),
        misplaced=int((off_m > WRONG_M).sum()),
        worst_m=round(float(off_m.max()), 3),
        cpu_s=round(cpu_s, 1),
    )


def errors_m(engine: Engine, survey: Survey, frames: list[int]) -> np.ndarray:
    """Return how far the cameras (N,) of a part are off after its best fit to the truth."""
    centres = np.array([engine.state.map_from_cam(i).translation for i in frames])
    truth = np.array([survey.views[i].enu_from_cam.translation for i in frames])
    fit = weighted_similarity(centres, truth, np.ones(len(frames)))
    return np.asarray(np.linalg.norm(fit.apply(centres) - truth, axis=1))


def main() -> int:
    """Run what the command line names, print a line of JSON for each run and the sums; 1 where anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("surveys", nargs="+", choices=list(SURVEYS))
    parser.add_argument("--seeds", type=int, default=30, help="how many (default: 30)")
    parser.add_argument("--first-seed", type=int, default=100, help="the first of them (default: 100)")
    parser.add_argument("--positions", action="store_true", help="with the positions in the tags")
    chosen = parser.parse_args()
    rows = []
    for name in chosen.surveys:
        for seed in range(chosen.first_seed, chosen.first_seed + chosen.seeds):
            with tempfile.TemporaryDirectory() as work:
                rows.append(measure(name, chosen.positions, seed, Path(work)))
            print(json.dumps(dataclasses.asdict(rows[-1])), flush=True)
    for name in chosen.surveys:
        own = [row for row in rows if row.survey == name]
        print(
            f"{name}: {len(own)} runs, wrong in {sum(row.misplaced > 0 for row in own)}, "
            f"one part in {sum(len(row.parts) == 1 for row in own)}, "
            f"coverage {sum(row.placed for row in own) / sum(row.images for row in own):.3f}"
        )
    return int(any(row.misplaced for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
