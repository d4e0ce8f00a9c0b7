"""Whole runs of the engine with the oracle: the truth is known, a run takes a second or two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from onthefly3r.engine.loop import Engine
from onthefly3r.geometry.transforms import Sim3, rotation_angle_deg
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.options import Options
from onthefly3r.records import LocalModel, Rejection, Shot, Subset, WorkingImage
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
NO_GPS = {"gps_candidates": False, "gps_check": False, "gps_priors": False}

survey_of = lru_cache(maxsize=None)(scenario)


class Recorder(OracleBackbone):
    """The oracle, which remembers what it was asked and which views it spoilt."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self.asked: list[tuple[Subset, set[int]]] = []

    def reconstruct(self, subset: Subset, images: Any, calibrations: Any) -> LocalModel | Rejection:
        self._bad_now: set[int] = set()
        model = super().reconstruct(subset, images, calibrations)
        self.asked.append((subset, self._bad_now))
        return model

    def _draw_bad_views(self, subset: Subset, rng: np.random.Generator) -> set[int]:
        self._bad_now = super()._draw_bad_views(subset, rng)
        return self._bad_now


class WatchedEngine(Engine):
    """The engine, which measures its error before and after each time it removes drift."""

    def __init__(self, survey: Survey, *args: Any) -> None:
        super().__init__(*args)
        self.survey = survey
        self.optimised: list[tuple[float, float]] = []
        optimise = self.drift.optimise

        def watched(fragment: int) -> None:
            before = ate_m(self, survey)
            optimise(fragment)
            self.optimised.append((before, ate_m(self, survey)))

        self.drift.optimise = watched  # type: ignore[method-assign]


@dataclass(frozen=True)
class Outcome:
    engine: WatchedEngine
    backbone: Recorder
    coverage: float
    ate_m: float
    worst_m: float
    worst_deg: float
    mean_batch: float
    work: Path

    @property
    def optimised(self) -> list[tuple[float, float]]:
        """ATE before and after each optimisation, m."""
        return self.engine.optimised


def run(
    work: Path,
    survey: Survey,
    faults: Faults | None = None,
    *,
    seed: int = 0,
    shuffle: int | None = None,
    live: bool = False,
    tokens: bool = False,
    noise: Any = None,
    shots: list[Shot] | None = None,
    **options: Any,
) -> Outcome:
    """Feed a survey to a new engine in capture order or shuffled, all at once or one by one."""
    if shuffle is not None:
        order = np.random.default_rng(shuffle).permutation(len(survey.views))
        survey = replace(survey, views=tuple(survey.views[i] for i in order))
    images = oracle_images(survey, GRID_PX)
    by_name = {image.shot.name: image for image in images.values()}

    def load(shot: Shot) -> WorkingImage:
        return by_name[shot.name]

    backbone = Recorder(survey, noise, faults, seed, tokens, GRID_PX)
    engine = WatchedEngine(survey, work, Options.from_flat(options), backbone, OracleDescriber(survey, seed=seed), load)
    shots = shots or oracle_shots(survey)
    if live:
        for shot in shots:
            engine.add(shot)
    else:
        engine.add_all(shots)
    engine.finish()
    distance_m, angle_deg, _ = camera_errors(engine, survey)
    return Outcome(
        engine=engine,
        backbone=backbone,
        coverage=len(distance_m) / len(shots),
        ate_m=float(np.sqrt(np.mean(distance_m**2))),
        worst_m=float(distance_m.max()),
        worst_deg=float(angle_deg.max()),
        mean_batch=engine.details()["mean_batch"],
        work=work,
    )


def camera_errors(engine: Engine, survey: Survey) -> tuple[np.ndarray, np.ndarray, Sim3]:
    """Distances (N,) m and angles (N,) deg of the placed cameras after the best fit of their centres, and that fit."""
    poses = {i: engine.state.map_from_cam(i) for i in engine.state.frames}
    centres = np.array([pose.translation for pose in poses.values()])
    truth = np.array([survey.views[i].enu_from_cam.translation for i in poses])
    enu_from_map = weighted_similarity(centres, truth, np.ones(len(centres)))
    angles = [
        rotation_angle_deg(enu_from_map.rotation @ pose.rotation @ survey.views[i].enu_from_cam.rotation.T)
        for i, pose in poses.items()
    ]
    return np.linalg.norm(enu_from_map.apply(centres) - truth, axis=1), np.array(angles), enu_from_map


def ate_m(engine: Engine, survey: Survey) -> float:
    return float(np.sqrt(np.mean(camera_errors(engine, survey)[0] ** 2)))


def gap_between_cloud_and_cameras_px(outcome: Outcome) -> float:
    """How far, in the median of the worst image, points are from the pixels that predicted them, seen from the map."""
    worst = 0.0
    state = outcome.engine.state
    for index in state.frames:
        reference = state.reference(index)
        in_map = state.submap_pose_of(index).apply(reference.points.astype(float))
        seen = state.frames[index].camera.project(state.map_from_cam(index).inverse().apply(in_map))
        offset = np.linalg.norm(seen - (reference.pixels + 0.5), axis=1)
        worst = max(worst, float(np.median(offset)))
    return worst
