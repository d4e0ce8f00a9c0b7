from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from onthefly3r.geometry.transforms import Sim3
from onthefly3r.records import LocalModel
from onthefly3r.registration.references import (
    CELLS_ACROSS,
    MAX_PAIRS_PER_REFERENCE,
    compact_reference,
    correspond,
    scene_spacing,
    spread_sample,
)
from synthetic_models import CAMERA, HEIGHT_M, MAP_FROM_LOCAL, local_model, true_references, true_view


def test_points_are_spread_over_the_grid_with_the_most_confident_of_each_cell() -> None:
    rng = np.random.default_rng(0)
    view = replace(true_view(0), confidence=rng.uniform(0.5, 1.0, (42, 56)).astype(np.float32))
    reference = compact_reference(view, 300, 0.5)
    cell_px = -(-CAMERA.width // CELLS_ACROSS)
    cells_down = -(-CAMERA.height // cell_px)
    per_cell = 300 // (CELLS_ACROSS * cells_down)
    columns, rows = reference.pixels.T
    cell = rows // cell_px * CELLS_ACROSS + columns // cell_px
    filled, counts = np.unique(cell, return_counts=True)
    assert len(filled) == -(-CAMERA.width // cell_px) * cells_down
    assert counts.max() == per_cell
    for one in filled:
        r, c = divmod(int(one), CELLS_ACROSS)
        all_of_cell = view.confidence[r * cell_px : (r + 1) * cell_px, c * cell_px : (c + 1) * cell_px].ravel()
        expected = np.sort(all_of_cell)[::-1][:per_cell]
        np.testing.assert_array_equal(np.sort(reference.confidence[cell == one])[::-1], expected)


def test_points_that_recur_come_before_more_confident_ones() -> None:
    rng = np.random.default_rng(1)
    confidence = rng.uniform(0.4, 1.0, (42, 56)).astype(np.float32)
    recurring = rng.random((42, 56)) < 0.05
    view = replace(true_view(0), confidence=confidence, recurring=recurring)
    columns, rows = compact_reference(view, 600, 0.5).pixels.T
    kept = np.zeros_like(recurring)
    kept[rows, columns] = True
    assert (confidence[kept] >= 0.5).all()
    usable = recurring & (confidence >= 0.5)
    assert kept[usable].mean() > 0.95  # a cell may have more of them than it may keep
    np.testing.assert_array_equal(compact_reference(view, 600, 0.5).confidence, confidence[rows, columns])


def test_points_and_confidences_belong_to_their_pixels() -> None:
    view = true_view(3)
    reference = compact_reference(view, 500, 0.5)
    columns, rows = reference.pixels.T
    np.testing.assert_array_equal(reference.points, view.points[rows, columns])
    np.testing.assert_array_equal(reference.confidence, view.confidence[rows, columns])
    assert (reference.pixels.dtype, reference.points.dtype) == (np.int32, np.float32)


@pytest.mark.parametrize("most", [50, 300, 2000])
def test_the_number_of_points_is_bounded(most: int) -> None:
    kept = len(compact_reference(true_view(0), most, 0.5).pixels)
    assert kept <= max(most, CELLS_ACROSS * CELLS_ACROSS)  # never less than one a cell
    assert kept >= 0.5 * most


def test_unknown_and_doubtful_pixels_are_left_out() -> None:
    view = true_view(0)
    points, confidence = view.points.copy(), view.confidence.copy()
    points[:10] = np.nan
    confidence[10:20] = 0.49
    rows = compact_reference(replace(view, points=points, confidence=confidence), 2000, 0.5).pixels[:, 1]
    assert rows.min() >= 20
    empty = compact_reference(replace(view, confidence=np.zeros_like(confidence)), 2000, 0.5)
    assert empty.pixels.shape == (0, 2) and empty.points.shape == (0, 3)


def test_pairs_show_the_same_ground_point_in_both_frames() -> None:
    model = local_model([0, 1, 6], noise_m=0.0)
    references = true_references([0, 1])
    submap = Sim3(1.0, np.eye(3), np.array([7.0, 8.0, 9.0]))
    pairs = correspond(model, references, {0: Sim3(), 1: submap}, 0.5)
    own = MAP_FROM_LOCAL.apply(pairs.local)
    own[pairs.reference == 1] += (7.0, 8.0, 9.0)
    np.testing.assert_allclose(pairs.map, own, atol=2e-3)  # float32 of points 300 m from the origin
    assert set(np.unique(pairs.reference)) == {0, 1}


def test_weights_are_the_root_of_both_confidences() -> None:
    references = {0: replace(true_references([0])[0])}
    references[0] = replace(references[0], confidence=np.full_like(references[0].confidence, 0.64))
    model = local_model([0, 1])
    view = replace(model.views[0], confidence=np.full((42, 56), 0.81, np.float32))
    pairs = correspond(LocalModel({0: view}), references, {0: Sim3()}, 0.5)
    np.testing.assert_allclose(pairs.weight, 0.8 * 0.9, rtol=1e-6)


def test_doubtful_local_points_and_missing_views_give_no_pairs() -> None:
    references, poses = true_references([0, 1]), {0: Sim3(), 1: Sim3()}
    model = local_model([0])
    confidence = np.where(np.arange(56) < 28, 0.9, 0.3) * np.ones((42, 1))
    half = LocalModel({0: replace(model.views[0], confidence=confidence.astype(np.float32))})
    pairs = correspond(half, references, poses, 0.5)
    assert set(pairs.reference) == {0}
    assert len(pairs.weight) == (references[0].pixels[:, 0] < 28).sum()
    assert len(correspond(LocalModel({}), references, poses, 0.5).weight) == 0


def test_one_reference_gives_a_bounded_number_of_pairs_from_all_over_the_image() -> None:
    pairs = correspond(local_model([0], noise_m=0.0), true_references([0], 2000), {0: Sim3()}, 0.5)
    assert len(pairs.weight) == MAX_PAIRS_PER_REFERENCE
    x, y, _ = pairs.map.T
    extent = true_view(0).points.reshape(-1, 3)
    assert np.ptp(x) > 0.9 * np.ptp(extent[:, 0]) and np.ptp(y) > 0.9 * np.ptp(extent[:, 1])


def test_spread_sample_keeps_few_items_and_thins_many_evenly() -> None:
    np.testing.assert_array_equal(spread_sample(np.arange(4), 5), np.arange(4))
    thinned = spread_sample(np.arange(1000), 10)
    assert len(set(thinned)) == 10 and thinned[0] == 0 and thinned[-1] == 999
    assert np.ptp(np.diff(thinned)) <= 1


def test_scene_spacing_is_the_ground_distance_of_neighbouring_pixels() -> None:
    """100 m over ground that rises and falls by 4 m, focal length 48 px: a little over 2.08 m."""
    spacing = scene_spacing({0: true_view(0), 3: true_view(3)}, 0.5)
    assert spacing == pytest.approx(HEIGHT_M / CAMERA.fx, rel=0.06)
    nothing = replace(true_view(0), confidence=np.zeros((42, 56), np.float32))
    assert np.isnan(scene_spacing({0: nothing}, 0.5))
    assert np.isnan(scene_spacing({}, 0.5))
