"""Surveys that do not hang together: fragments begin, grow, join where they meet, and lie right where they do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r.geometry.geodesy import EnuFrame
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.options import GeoreferenceOptions
from onthefly3r.records import LocalModel, Rejection, Subset
from onthefly3r.run.parts import laid_out, main_reference
from onthefly3r.simulate import Survey
from onthefly3r.simulate.oracle import Faults, covisible_groups, footprint_centre
from oracle_runs import NO_GPS, Outcome, Recorder, run, survey_of

FOOTPRINT_M = 0.6 * 147.0  # footprints nearer to each other than this see enough of the same ground
STRAYS = Faults(strays=True)  # what shares no ground with the others of a subset is put anywhere


def without_middle(survey: Survey) -> Survey:
    """The survey without a belt across its strips: two halves that share no ground."""
    north = np.array([view.enu_from_cam.translation[1] for view in survey.views])
    low, high = np.quantile(north, [0.35, 0.65])
    return replace(survey, views=tuple(v for v, y in zip(survey.views, north, strict=True) if not low <= y <= high))


def worst_of_parts_m(outcome: Outcome) -> float:
    """How far the worst camera is off after each part is fitted for itself."""
    worst = 0.0
    state, views = outcome.engine.state, outcome.engine.survey.views
    for frames in state.fragments().values():
        centres = np.array([state.map_from_cam(i).translation for i in frames])
        truth = np.array([views[i].enu_from_cam.translation for i in frames])
        fit = weighted_similarity(centres, truth, np.ones(len(frames)))
        worst = max(worst, float(np.linalg.norm(fit.apply(centres) - truth, axis=1).max()))
    return worst


@pytest.mark.parametrize("options", [{}, NO_GPS], ids=["gps", "no gps"])
def test_two_halves_are_two_parts_that_positions_lay_out(tmp_path: Path, options: dict[str, bool]) -> None:
    outcome = run(tmp_path, without_middle(survey_of(120, 8)), STRAYS, **options)
    engine = outcome.engine
    assert len(engine.state.fragments()) == 2 and outcome.coverage >= 0.98
    assert worst_of_parts_m(outcome) < 1.5
    assert_same_place(engine.state, MapState.load(Store(tmp_path)))
    georeferencing = GeoreferenceOptions()
    reference = main_reference(engine.state, engine.shots, georeferencing, None)
    whole, found, lost, told = laid_out(engine.state, engine.shots, georeferencing, reference)
    assert not lost and len(told) == 1 and "not connected" in told[0]
    assert found is not None and set(found.residuals_m) == set(engine.state.frames)
    origin = EnuFrame(found.origin_lat_deg, found.origin_lon_deg, found.origin_height_m)
    geographic = origin.to_geographic(
        np.array([found.enu_from_map.apply(whole.map_from_cam(i).translation) for i in whole.frames])
    )
    placed = engine.survey.origin.from_geographic(geographic)
    truth = np.array([engine.survey.views[i].enu_from_cam.translation for i in whole.frames])
    assert np.linalg.norm(placed - truth, axis=1).max() < 2.0


def test_local_coordinates_have_no_place_for_a_second_part(tmp_path: Path) -> None:
    engine = run(tmp_path, without_middle(survey_of(120, 8)), STRAYS).engine
    sizes = [len(frames) for frames in engine.state.fragments().values()]
    whole, _, lost, told = laid_out(engine.state, engine.shots, GeoreferenceOptions(), None)
    assert len(whole.frames) == sizes[0] and len(lost) == sizes[1]
    assert {r.stage for r in lost.values()} == {"fragments"} and "Fly once more between" in told[0]


def test_the_papers_preset_keeps_the_single_map(tmp_path: Path) -> None:
    outcome = run(tmp_path, without_middle(survey_of(120, 8)), STRAYS, preset="paper")
    assert len(outcome.engine.state.fragments()) == 1


def test_an_easy_survey_stays_one_map_from_one_seed(tmp_path: Path) -> None:
    details = run(tmp_path, survey_of(60, 4)).engine.details()
    assert (details["fragments"], details["joins"], details["weakly_tied"]) == (1.0, 0.0, 0.0)


def assert_same_place(one: MapState, other: MapState) -> None:
    assert one.fragments() == other.fragments()
    for index in one.frames:
        np.testing.assert_allclose(one.map_from_cam(index).matrix(), other.map_from_cam(index).matrix(), atol=1e-12)


def test_a_seed_that_falls_apart_begins_with_the_part_that_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A local reconstructor of several places gives one of them, as structure from motion does."""
    whole = Recorder.reconstruct
    sizes = []

    def largest_only(self: Recorder, subset: Subset, images: Any, calibrations: Any) -> LocalModel | Rejection:
        model = whole(self, subset, images, calibrations)
        assert isinstance(model, LocalModel)
        views = self._survey.views
        places = np.stack([footprint_centre(views[i]) for i in subset.members])
        held = {subset.members[k] for k in covisible_groups(places, FOOTPRINT_M)[0]}
        sizes.append((len(subset.references), len(subset.new), len(held)))
        return replace(model, views={i: view for i, view in model.views.items() if i in held})

    monkeypatch.setattr(Recorder, "reconstruct", largest_only)
    survey = survey_of(80, 8)
    order = [i for at_once in zip(range(12), range(40, 52), range(68, 80), strict=True) for i in at_once]
    rest = [i for i in range(80) if i not in order]
    outcome = run(tmp_path, replace(survey, views=tuple(survey.views[i] for i in order + rest)), live=True, **NO_GPS)
    references, new, held = sizes[0]
    assert (references, new) == (0, 30) and 10 <= held < 15  # fewer than half of it hold together
    assert sizes[1][0] > 0  # it was not thrown away and another seed tried
    assert sum(frame.submap == 0 for frame in outcome.engine.state.frames.values()) == held
    assert outcome.coverage >= 0.98 and worst_of_parts_m(outcome) < 1.5
