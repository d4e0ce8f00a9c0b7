"""The loop over images: what it asks for, what it keeps, and the switches of the paper's ablation."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r.engine.loop import Engine
from onthefly3r.errors import Cancelled, PhotographError
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.options import Options
from onthefly3r.records import LocalModel, Rejection, Subset
from onthefly3r.simulate.oracle import Faults, OracleBackbone, OracleDescriber, oracle_shots
from oracle_runs import GRID_PX, NO_GPS, camera_errors, run, survey_of

# The paper's ablation: dynamic batching, validation and retry, pose graph.
CASES = {
    1: {"batching": "fixed", "validation": False, "pose_graph": "none"},
    2: {"batching": "dynamic", "validation": False, "pose_graph": "none"},
    3: {"batching": "fixed", "validation": True, "pose_graph": "none"},
    4: {"batching": "dynamic", "validation": True, "pose_graph": "none"},
    5: {"batching": "dynamic", "validation": True, "pose_graph": "se3"},
}


def test_a_journal_gives_the_map_of_a_whole_run_again(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(60, 4), Faults(bad_query_rate=0.3))
    state, again = outcome.engine.state, MapState.load(Store(tmp_path))
    assert list(again.frames) == list(state.frames) and again.spacing == state.spacing
    assert again.calibrations == state.calibrations and len(again.calibrations) == 1
    assert len(again.sightings) == len(state.sightings) and again.next_submap() == state.next_submap()
    for index in state.frames:
        np.testing.assert_allclose(again.map_from_cam(index).matrix(), state.map_from_cam(index).matrix(), atol=1e-14)
        np.testing.assert_array_equal(again.reference(index).points, state.reference(index).points)


def test_the_papers_journal_gives_its_moved_cameras_again(tmp_path: Path) -> None:
    state = run(tmp_path, survey_of(60, 4), preset="paper").engine.state
    again = MapState.load(Store(tmp_path))
    assert len(again.frame_edges) == len(state.frame_edges) > 0
    for index in state.frames:
        np.testing.assert_allclose(again.map_from_cam(index).matrix(), state.map_from_cam(index).matrix(), atol=1e-14)


def test_a_run_is_the_same_each_time(tmp_path: Path) -> None:
    first, second = (run(tmp_path / name, survey_of(60, 4)).engine.state for name in "ab")
    assert list(first.frames) == list(second.frames)
    assert all((first.map_from_cam(i).matrix() == second.map_from_cam(i).matrix()).all() for i in first.frames)


@pytest.mark.parametrize("case", CASES)
def test_cases_of_the_papers_ablation(tmp_path: Path, case: int) -> None:
    """Half of the subsets hold a bad reference, a third a bad query: only validation keeps them out."""
    faults = Faults(bad_references=1, bad_reference_rate=0.5, bad_query_rate=0.3)
    outcome = run(tmp_path, survey_of(60, 4), faults, preset="paper", **CASES[case])
    asked = [subset for subset, _ in outcome.backbone.asked if subset.references]
    if CASES[case]["batching"] == "fixed":
        arrivals = [i for subset in asked for i in subset.new]
        assert arrivals == sorted(arrivals) and {len(subset.new) for subset in asked} == {5}
    if CASES[case]["validation"]:
        assert outcome.engine.details()["pruned_references"] > 0 or outcome.engine.rejections
    else:
        assert outcome.coverage == 1.0 and not outcome.engine.rejections
        assert outcome.worst_m > 20.0  # what was bad is in the map
    assert bool(outcome.engine.state._moved) == (case == 5)


def test_the_papers_preset_takes_images_in_order_and_drops_what_it_rejects(tmp_path: Path) -> None:
    faults = Faults(bad_references=3, bad_reference_rate=0.5)
    outcome = run(tmp_path, survey_of(60, 4), faults, preset="paper")
    later = [subset for subset, _ in outcome.backbone.asked if subset.references]
    assert all(len(subset.references) <= 5 for subset in later)
    new = [i for subset in later for i in subset.new]
    assert new == sorted(new) and len(new) == len(set(new))  # nothing is tried again
    assert outcome.engine.rejections and outcome.coverage < 0.99


def test_rejected_images_come_back_when_the_map_has_grown(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(60, 4), Faults(bad_query_rate=0.6), **NO_GPS)
    retried = [i for i, count in outcome.engine.retries.items() if count]
    assert retried and set(retried) <= set(outcome.engine.state.frames) | set(outcome.engine.rejections)
    assert outcome.coverage >= 0.98 and outcome.worst_m < 5.0
    assert outcome.engine.details()["retried_images"] == len(retried)


def test_context_tokens_drop_a_reference_and_infer_once_more(tmp_path: Path) -> None:
    faults = Faults(bad_references=2, bad_reference_rate=0.5)
    few_spare = {"subset_references": 6, "min_references": 5}
    with_tokens = run(tmp_path, survey_of(60, 4), faults, tokens=True, **few_spare, **NO_GPS)
    asked = [subset for subset, _ in with_tokens.backbone.asked]
    repeated = [
        (before, after)
        for before, after in pairwise(asked)
        if before.new == after.new and set(after.references) < set(before.references)
    ]
    assert repeated
    assert with_tokens.worst_m < 5.0


def test_a_wrong_gps_tag_is_outvoted_by_two_reconstructions(tmp_path: Path) -> None:
    survey = survey_of(60, 4)
    last = list(run(tmp_path / "right", survey).engine.state.frames)[-1]
    shots = oracle_shots(survey)
    fix = shots[last].gps
    assert fix is not None
    shots[last] = replace(shots[last], gps=replace(fix, lat_deg=fix.lat_deg + 0.0006))
    outcome = run(tmp_path / "wrong", survey, shots=shots)
    assert outcome.engine.retries == {last: 1}  # 67 m off: a second opinion was asked for
    assert outcome.coverage == 1.0 and outcome.worst_m < 2.0


def test_one_by_one_gives_a_map_before_the_end(tmp_path: Path) -> None:
    survey = survey_of(60, 4)
    placed: list[int] = []
    engine = Engine(
        tmp_path,
        Options(),
        run(tmp_path / "oracle", survey).backbone,
        OracleDescriber(survey),
        run(tmp_path / "images", survey).engine.images._load,
    )
    for shot in oracle_shots(survey):
        engine.add(shot)
        placed.append(len(engine.state.frames))
    assert placed[28] == 0 and placed[29] >= 25
    assert max(np.diff(placed[30:])) <= 5 and placed[-1] >= 45
    engine.finish()
    assert len(engine.state.frames) == 60
    assert camera_errors(engine, survey)[0].max() < 2.0


def empty_engine(work: Path, **named: object) -> Engine:
    survey = survey_of(60, 4)
    outcome = run(work / "first", survey)
    return Engine(
        work / "second", Options(), outcome.backbone, OracleDescriber(survey), outcome.engine.images._load, **named
    )  # type: ignore[arg-type]


def test_unreadable_photographs_are_reported_and_stop_nothing(tmp_path: Path) -> None:
    engine = empty_engine(tmp_path)
    load = engine.images._load

    def sometimes(shot: object) -> object:
        if shot.name.endswith("07.JPG"):  # type: ignore[attr-defined]
            raise PhotographError(Path("x.JPG"), "its pixels are damaged")
        return load(shot)  # type: ignore[arg-type]

    engine.images._load = sometimes  # type: ignore[assignment]
    engine.add_all(oracle_shots(survey_of(60, 4)))
    engine.finish()
    assert set(engine.rejections) == {6}
    assert engine.rejections[6].stage == "intake" and "damaged" in engine.rejections[6].reason
    assert len(engine.state.frames) == 59


def test_images_that_share_nothing_leave_reasons(tmp_path: Path) -> None:
    """Two images make no map."""
    engine = empty_engine(tmp_path)
    engine.add_all(oracle_shots(survey_of(60, 4))[:2])
    engine.finish()
    assert not engine.state.frames
    assert {r.stage for r in engine.rejections.values()} == {"seed"} and len(engine.rejections) == 2


def test_while_images_arrive_no_seed_is_the_last(tmp_path: Path) -> None:
    """Most images of every seed are bad: attempts go on as more arrive, and nothing is given up before the end."""
    engine = empty_engine(tmp_path)
    engine.backbone = OracleBackbone(
        survey_of(60, 4), None, Faults(bad_queries=28, bad_query_rate=1.0, in_seed=True), 0, False, GRID_PX
    )
    calls = []
    for shot in oracle_shots(survey_of(60, 4)):
        engine.add(shot)
        calls.append(engine.backbone_calls)
    assert 0 == calls[28] < calls[29] < calls[-1] <= 10
    assert not engine.state.frames and not engine.rejections
    engine.finish()
    assert not engine.state.frames
    assert len(engine.rejections) == 60 and {r.stage for r in engine.rejections.values()} == {"seed"}
    assert all(r.numbers["attempts"] > 0 for r in engine.rejections.values())


def test_cancelling_ends_the_run_and_keeps_what_was_placed(tmp_path: Path) -> None:
    answers = iter([False] * 7)  # 60 photographs are read in one to four steps
    engine = empty_engine(tmp_path, cancel=lambda: next(answers, True))
    with pytest.raises(Cancelled):
        engine.add_all(oracle_shots(survey_of(60, 4)))
        engine.finish()
    assert len(MapState.load(Store(tmp_path / "second")).frames) >= 25


class Vanishing:
    """A backbone on a disk from which three photographs go after some calls."""

    gone = (7, 31, 50)

    def __init__(self, inner: OracleBackbone, calls: int) -> None:
        self.spec = inner.spec
        self._inner = inner
        self._calls_left = calls

    def reconstruct(self, subset: Subset, images: Any, calibrations: Any) -> LocalModel | Rejection:
        self._calls_left -= 1
        for index in set(subset.members) & set(self.gone) if self._calls_left < 0 else ():
            raise PhotographError(images[index].shot.name, "cannot be read (gone)")
        return self._inner.reconstruct(subset, images, calibrations)


@pytest.mark.parametrize("calls", [0, 4])
def test_photographs_that_go_meanwhile_are_left_out(tmp_path: Path, calls: int) -> None:
    """Before the seed all three are lost; later those that are in the map stay, and no more is asked of them."""
    engine = empty_engine(tmp_path)
    engine.backbone = Vanishing(engine.backbone, calls)  # type: ignore[arg-type]
    engine.add_all(oracle_shots(survey_of(60, 4)))
    engine.finish()
    lost = [i for i in Vanishing.gone if i not in engine.state.frames]
    assert len(engine.state.frames) == 60 - len(lost)
    assert sorted(engine.rejections) == lost
    assert {(r.stage, r.reason) for r in engine.rejections.values()} <= {("intake", "cannot be read (gone)")}
    assert len(lost) == 3 if calls == 0 else len(lost) < 3


def test_progress_counts_images(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int, int]] = []
    engine = empty_engine(tmp_path, progress=lambda p: seen.append((p.stage, p.placed, p.rejected, p.waiting)))
    engine.add_all(oracle_shots(survey_of(60, 4)))
    engine.finish()
    steps = [s for s in seen if s[0] == "reconstructing"]
    assert steps[-1][1:] == (60, 0, 0)
    assert all(placed + rejected + waiting == 60 for _, placed, rejected, waiting in steps)
