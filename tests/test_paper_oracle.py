"""The oracle's errors that grow with extent, and what it does with views that do not belong together."""

from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.records import LocalModel, Subset
from onthefly3r.simulate import Survey
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
