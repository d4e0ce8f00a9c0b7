"""The method's known weaknesses, each as a whole run with the oracle: 100 m altitude, overlaps 80 and 65 %.

The published method was measured on the same scenarios: ATE 0.56 to 0.69 m on 60 images, 0.80 m on 160, 0.95 m with
domed local models (and a cloud 4 m off its cameras), 1.12 m on 360; coverage 0.89 to 0.91 with bad references or
queries, which put an image 40 m and 30 degrees off; 1.25 images a batch when shuffled.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from onthefly3r.simulate.oracle import Faults, Noise
from oracle_runs import NO_GPS, Outcome, gap_between_cloud_and_cameras_px, run, survey_of

MISPLACED_M, MISPLACED_DEG = 5.0, 5.0


def check_sound(outcome: Outcome, ate_m: float = 0.6) -> None:
    assert outcome.coverage >= 0.99
    assert outcome.ate_m <= ate_m
    assert outcome.worst_m < MISPLACED_M and outcome.worst_deg < MISPLACED_DEG
    for before, after in outcome.optimised:
        assert after <= 1.02 * before


@pytest.mark.parametrize("seed", range(4))
def test_sixty_images_in_four_strips(tmp_path: Path, seed: int) -> None:
    outcome = run(tmp_path, survey_of(60, 4, seed), seed=seed)
    check_sound(outcome, 0.4)


@pytest.mark.parametrize("seed", range(2))
def test_without_positions(tmp_path: Path, seed: int) -> None:
    check_sound(run(tmp_path, survey_of(60, 4, seed), seed=seed, **NO_GPS), 0.5)


def test_shuffled_input_fills_batches(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(60, 4), shuffle=0)
    check_sound(outcome, 0.4)
    assert outcome.mean_batch >= 4.0


@pytest.mark.slow
@pytest.mark.parametrize("shuffle", [None, 1])
def test_images_that_arrive_one_by_one(tmp_path: Path, shuffle: int | None) -> None:
    outcome = run(tmp_path, survey_of(160, 8), live=True, shuffle=shuffle)
    check_sound(outcome, 0.5)
    assert outcome.mean_batch >= 4.0


@pytest.mark.slow
def test_a_hundred_and_sixty_domed_local_models(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(160, 8), Faults(doming_m=1.0))
    check_sound(outcome, 1.0)
    assert gap_between_cloud_and_cameras_px(outcome) < 0.05


def test_only_the_papers_graph_leaves_the_cloud_behind_its_cameras(tmp_path: Path) -> None:
    """Its cameras move by as much as there is drift to remove, and the cloud stays; ours move together."""
    paper = run(tmp_path / "paper", survey_of(60, 4), preset="paper")
    ours = run(tmp_path / "ours", survey_of(60, 4))
    assert gap_between_cloud_and_cameras_px(paper) > 0.2
    assert gap_between_cloud_and_cameras_px(ours) < 0.01


@pytest.mark.slow
def test_three_hundred_and_sixty_images_do_not_drift(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(360, 12))
    check_sound(outcome, 0.4)
    assert max(before for before, _ in outcome.optimised) > 1.2 * outcome.ate_m  # there was drift to remove


@pytest.mark.slow
def test_three_hundred_and_sixty_images_without_positions(tmp_path: Path) -> None:
    check_sound(run(tmp_path, survey_of(360, 12), **NO_GPS), 0.7)


@pytest.mark.parametrize("bad", [1, 2])
@pytest.mark.parametrize("gps", [True, False])
def test_bad_references_in_half_of_the_subsets(tmp_path: Path, bad: int, gps: bool) -> None:
    faults = Faults(bad_references=bad, bad_reference_rate=0.5)
    outcome = run(tmp_path, survey_of(60, 4), faults, seed=1, **({} if gps else NO_GPS))
    check_sound(outcome)
    assert outcome.engine.details()["pruned_references"] > 0


@pytest.mark.parametrize(("images", "strips"), [(60, 4), (160, 8)])
@pytest.mark.parametrize("gps", [True, False])
def test_a_bad_query_in_a_third_of_the_subsets(tmp_path: Path, images: int, strips: int, gps: bool) -> None:
    outcome = run(tmp_path, survey_of(images, strips), Faults(bad_query_rate=0.3), **({} if gps else NO_GPS))
    check_sound(outcome)
    assert any(bad for _, bad in outcome.backbone.asked)  # there was something to refuse


def test_a_seed_that_does_not_hang_together_is_refused_and_another_tried(tmp_path: Path) -> None:
    faults = Faults(bad_queries=20, bad_query_rate=0.7, in_seed=True)
    outcome = run(tmp_path, survey_of(60, 4), faults, seed=3, max_retries=6)
    seeds = [bad for subset, bad in outcome.backbone.asked if not subset.references]
    assert len(seeds) > 1 and len(seeds[0]) == 20
    assert outcome.worst_m < MISPLACED_M and outcome.worst_deg < MISPLACED_DEG
    assert outcome.coverage >= 0.9


def test_bad_images_of_a_seed_are_left_out_of_it(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(60, 4), Faults(bad_queries=3, bad_query_rate=0.3, in_seed=True), seed=2)
    _, bad = outcome.backbone.asked[0]
    assert len(bad) == 3
    check_sound(outcome)
    assert not bad & {i for i, frame in outcome.engine.state.frames.items() if frame.submap == 0}


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, NO_GPS], ids=["gps", "no gps"])
def test_look_alike_blocks_are_not_confused(tmp_path: Path, options: dict[str, bool]) -> None:
    survey = survey_of(160, 8, look_alike=True)
    check_sound(run(tmp_path, survey, Faults(strays=True), **options))


def test_leftovers_carry_stage_reason_and_numbers(tmp_path: Path) -> None:
    """Every new image is bad: nothing beyond the seed may enter, and nothing is lost."""
    outcome = run(tmp_path, survey_of(40, 4), Faults(bad_queries=5, bad_query_rate=1.0), **NO_GPS)
    engine = outcome.engine
    assert set(engine.rejections) == set(engine.shots) - set(engine.state.frames)
    assert len(engine.rejections) >= 8
    for index, rejection in engine.rejections.items():
        assert rejection.images == (index,)
        assert rejection.stage == "queries" and rejection.reason
        assert np.isfinite(rejection.numbers["overlap_points"])
        assert engine.retries[index] >= engine.options.registration.max_retries
    assert outcome.worst_m < MISPLACED_M


def test_the_papers_preset_follows_a_sound_survey_in_order(tmp_path: Path) -> None:
    outcome = run(tmp_path, survey_of(100, 5), noise=Noise(bend_m=0.3), preset="paper")
    asked = [subset.new for subset, _ in outcome.backbone.asked]
    assert asked[0] == tuple(range(30))  # the first images that hang together, not the densest group
    assert outcome.coverage == 1.0 and outcome.ate_m < 1.0
    edges = {(e.source, e.target) for e in outcome.engine.state.frame_edges}
    assert {(a, b) for a in range(30) for b in range(a + 1, 30)} <= edges
    ((before_m, after_m),) = [(b, a) for b, a in outcome.optimised if b != a]
    assert after_m < before_m


@pytest.mark.parametrize("live", [False, True])
def test_fixed_batches_begin_with_the_first_images(tmp_path: Path, live: bool) -> None:
    outcome = run(tmp_path, survey_of(60, 4), batching="fixed", live=live)
    assert outcome.backbone.asked[0][0].new == tuple(range(30))
    assert outcome.backbone.asked[1][0].new == tuple(range(30, 35))
