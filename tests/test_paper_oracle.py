"""The oracle's errors that grow with extent, and what it does with views that do not belong together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.records import LocalModel, Subset
from onthefly3r.simulate import Survey
from onthefly3r.simulate.bends import Bend
from onthefly3r.simulate.landscape import BLOCK_SIZE_M
from onthefly3r.simulate.oracle import (
    Faults,
    Noise,
    OracleBackbone,
    covisible_groups,
    footprint_centre,
    oracle_images,
    scenario,
)

SILENT = Noise(0.0, 0.0, 0.0, 0.0)


def errors_m(survey: Survey, model: LocalModel, fitted: tuple[int, ...]) -> dict[int, float]:
    """Position errors of all cameras after a fit of some of them."""
    local = np.stack([model.views[i].local_from_cam.translation for i in fitted])
    true = np.stack([survey.views[i].enu_from_cam.translation for i in fitted])
    enu_from_local = weighted_similarity(local, true, np.ones(len(fitted)))
    return {
        i: float(
            np.linalg.norm(
                enu_from_local.apply(view.local_from_cam.translation) - survey.views[i].enu_from_cam.translation
            )
        )
        for i, view in model.views.items()
    }


def ask(backbone: OracleBackbone, members: tuple[int, ...]) -> LocalModel:
    model = backbone.reconstruct(Subset((), members), {}, {})
    assert isinstance(model, LocalModel)
    return model


def own_shift_m(survey: Survey, model: LocalModel) -> np.ndarray:
    """Position errors (3 N,) of all cameras after a fit."""
    local = np.stack([view.local_from_cam.translation for view in model.views.values()])
    true = np.stack([survey.views[i].enu_from_cam.translation for i in model.views])
    return (weighted_similarity(local, true, np.ones(len(true))).apply(local) - true).ravel()


def rms(values: dict[int, float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values.values())))))


def test_a_bend_grows_with_the_square_of_the_extent_and_changes_its_sign() -> None:
    survey = scenario(400, 20)
    backbone = OracleBackbone(survey, Noise(0.0, 0.0, 0.0, 0.0, bend_m=0.3), grid_side_px=16)
    whole = tuple(range(400))
    # A square of a quarter of the extent in the middle: a sixteenth of the error.
    middle = tuple(20 * strip + i for strip in range(7, 12) for i in range(7, 12))
    far = np.median([rms(errors_m(survey, ask(backbone, whole), whole)) for _ in range(25)])
    near = np.median([rms(errors_m(survey, ask(backbone, middle), middle)) for _ in range(25)])
    assert far > 1.0
    assert 8.0 < far / near < 32.0


def test_a_bend_of_third_order_is_odd_where_one_of_second_order_is_even() -> None:
    survey = scenario(100, 5)
    block = tuple(range(100))
    truth = np.stack([survey.views[i].enu_from_cam.translation for i in block])
    offset = (truth - truth.mean(axis=0))[:, :2] / 100.0
    even = np.column_stack([np.ones(100), offset, offset**2, offset.prod(axis=1)])
    odd = np.column_stack([even, offset**3, offset[:, :1] ** 2 * offset[:, 1:], offset[:, :1] * offset[:, 1:] ** 2])

    def height_left_m(noise: Noise, form: np.ndarray) -> float:
        up = own_shift_m(survey, ask(OracleBackbone(survey, noise, grid_side_px=16), block)).reshape(-1, 3)[:, 2]
        return float(np.std(up - form @ np.linalg.lstsq(form, up)[0]))

    second, third = Noise(0.0, 0.0, 0.0, 0.0, bend_m=0.3), Noise(0.0, 0.0, 0.0, 0.0, third_order_m=0.3)
    assert height_left_m(second, even) < 0.01
    assert height_left_m(third, even) > 10.0 * height_left_m(third, odd)


def test_a_bend_moves_the_ground_and_turns_plumb_lines_with_it() -> None:
    bend = Bend(np.zeros(3), np.zeros((2, 2)), 100.0, np.array([0.0, 2.0]))
    ground = np.array([[0.0, 100.0, 0.0], [70.0, -100.0, 0.0], [50.0, 0.0, 0.0]])
    np.testing.assert_allclose(bend.apply(ground)[:, 2], [2.0, -2.0, 0.0])
    step = 1e-3 * np.array([0.0, 1.0, 0.0])
    (before, after), (low, high) = (
        bend.apply(ground[0] + np.stack([-step, step])),
        bend.apply(ground[0] + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
    )
    assert abs((after - before) @ (high - low)) < 1e-6 * np.linalg.norm(after - before)
    assert Bend(np.zeros(3), np.zeros((2, 2)), 100.0).is_flat and not bend.is_flat


@pytest.mark.parametrize(("repeated", "share"), [(0.0, 0.0), (0.75, 0.75), (1.0, 1.0)])
def test_a_photograph_errs_alike_in_every_call_as_far_as_stated(repeated: float, share: float) -> None:
    survey = scenario(30, 2)
    group = tuple(range(30))
    backbone = OracleBackbone(survey, Noise(0.0, 3.0, 0.0, 0.0, repeated=repeated), grid_side_px=16)
    first, second = (
        np.concatenate([own_shift_m(survey, model) for model in (ask(backbone, group) for _ in range(12))][k::2])
        for k in (0, 1)
    )
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(share, abs=0.12)


def test_depth_errors_of_a_photograph_repeat_in_other_company_too() -> None:
    survey = scenario(30, 2)
    noise = Noise(0.0, 0.0, 0.01, 0.0, repeated=1.0)
    backbone = OracleBackbone(survey, noise, grid_side_px=16)
    views = [ask(backbone, members).views[3] for members in ((0, 1, 2, 3), (3, 4, 5, 18, 19))]
    depths = [v.local_from_cam.inverse().apply(v.points.astype(float))[..., 2] for v in views]
    ratio = depths[0] / depths[1]  # constant: only the frames' scales differ
    assert np.nanstd(ratio) < 1e-4 * np.nanmean(ratio)


def test_so_many_photographs_are_bad_in_every_call() -> None:
    survey = scenario(100, 5)
    backbone = OracleBackbone(survey, SILENT, Faults(bad_photograph_rate=0.09), grid_side_px=16)
    assert len(backbone.bad_photographs) == 9
    bad = sorted(backbone.bad_photographs)[0]
    company = tuple(i for i in range(100) if i not in backbone.bad_photographs)[:8]
    for _ in range(3):
        model = ask(backbone, (*company, bad))
        errors = errors_m(survey, model, company)
        assert model.notes["bad_views"] == 1.0
        assert errors[bad] > 30.0 and max(errors[i] for i in company) < 1e-6


@pytest.mark.parametrize(("confidence", "sign"), [("honest", -1), ("flat", 0), ("inverted", 1)])
def test_confidence_may_be_wrong(confidence: Any, sign: int) -> None:
    survey = scenario(30, 2)
    noise = Noise(0.0, 0.0, 0.01, 0.0, confidence=confidence)
    faults = Faults(bad_photograph_rate=0.1)
    backbone = OracleBackbone(survey, noise, faults, grid_side_px=64)
    views = ask(backbone, tuple(range(30))).views
    truth = backbone.true_depth(5)
    found = views[5].local_from_cam.inverse().apply(views[5].points.astype(float))[..., 2]
    error = np.abs(np.log(found / truth) - np.nanmedian(np.log(found / truth)))
    known = np.isfinite(error)
    correlation = float(np.corrcoef(error[known], views[5].confidence[known])[0, 1])
    assert abs(correlation) < 0.1 if sign == 0 else sign * correlation > 0.5
    usual = {i: float(np.mean(view.confidence[view.confidence > 0])) for i, view in views.items()}
    bad = [usual[i] for i in backbone.bad_photographs]
    good = [usual[i] for i in views if i not in backbone.bad_photographs]
    assert min(bad) > max(good) if sign > 0 else np.mean(bad) == pytest.approx(np.mean(good), abs=0.02)


@pytest.mark.parametrize("rate", [0.1, 0.3])
def test_every_view_is_bad_with_the_stated_chance(rate: float) -> None:
    survey = scenario(30, 2)
    backbone = OracleBackbone(survey, SILENT, Faults(bad_view_rate=rate), grid_side_px=16)
    bad = [ask(backbone, tuple(range(30))).notes["bad_views"] for _ in range(60)]
    # 1800 draws know a share of 0.3 to 0.011.
    assert np.mean(bad) / 30 == pytest.approx(rate, abs=0.035)


def test_a_view_far_from_the_others_is_put_among_them() -> None:
    survey = scenario(160, 8)
    group, stray = (0, 1, 2, 3, 36, 37, 38, 39), 90
    model = ask(OracleBackbone(survey, SILENT, Faults(strays=True), grid_side_px=16), (*group, stray))
    errors = errors_m(survey, model, group)
    assert max(errors[i] for i in group) < 1e-6
    centres = {i: survey.views[i].enu_from_cam.translation for i in (*group, stray)}
    away_m = float(np.linalg.norm(centres[stray] - np.mean([centres[i] for i in group], axis=0)))
    assert errors[stray] > 0.6 * away_m > 60.0
    assert model.notes["bad_views"] == 1.0
    honest = ask(OracleBackbone(survey, SILENT, grid_side_px=16), (*group, stray))
    assert errors_m(survey, honest, group)[stray] < 1e-6


def test_two_look_alike_blocks_are_taken_for_one() -> None:
    survey = scenario(160, 8, look_alike=True)
    places = np.stack([footprint_centre(view) for view in survey.views])
    inside = [
        [i for i, place in enumerate(places) if np.all((place >= corner) & (place < corner + BLOCK_SIZE_M))]
        for corner in survey.scene.blocks
    ]
    main, other = max(range(len(inside)), key=lambda k: len(inside[k])), 0
    assert len(inside[main]) > 3 and inside[other] and main != other
    first, second = tuple(inside[main]), inside[other][0]
    model = ask(OracleBackbone(survey, SILENT, Faults(strays=True), grid_side_px=16), (*first, second))
    offset_m = float(np.linalg.norm(survey.scene.blocks[main] - survey.scene.blocks[other]))
    assert errors_m(survey, model, first)[second] == pytest.approx(offset_m, rel=1e-6)


def test_groups_are_linked_through_their_members() -> None:
    places = np.array([[0.0, 0.0], [9.0, 0.0], [4.5, 0.0], [100.0, 0.0], [104.0, 0.0]])
    assert covisible_groups(places, 5.0) == [[0, 1, 2], [3, 4]]
    assert covisible_groups(places, 1.0) == [[0], [1], [2], [3], [4]]


def test_point_maps_are_as_coarse_as_asked_for() -> None:
    survey = scenario(6, 1)
    view = ask(OracleBackbone(survey, grid_side_px=64), (0, 1, 2)).views[1]
    assert view.points.shape == (48, 64, 3)
    assert oracle_images(survey, 64)[0].rgb.shape == (48, 64, 3)
