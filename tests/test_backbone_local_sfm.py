"""Local structure from motion on exact matches: flat ground, weak ties, images that hang by little."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from onthefly3r.adjust.sparse_model import SparseModel
from onthefly3r.backbones import local_sfm as module
from onthefly3r.backbones.local_sfm import local_sfm
from onthefly3r.geometry.arrays import Int
from onthefly3r.geometry.umeyama import weighted_similarity
from synthetic_block import CAMERA, HEIGHT, KEY, Block, block


def matches_of(truth: Block, most: int | None = None, seed: int = 0) -> dict[tuple[int, int], Int]:
    """The true matches of all pairs; of each pair `most` at random."""
    rng = np.random.default_rng(seed)
    found = {}
    for first, second in combinations(sorted(truth.poses), 2):
        _, rows, columns = np.intersect1d(truth.seen[first], truth.seen[second], return_indices=True)
        kept = rng.permutation(len(rows))[:most]
        found[first, second] = np.column_stack([rows, columns])[kept if len(rows) >= 15 else []]
    return found


def flat(noise_px: float) -> Block:
    """The block with all points in one plane."""
    hilly = block(noise_px=noise_px, n_points=900)
    points = hilly.points * (1.0, 1.0, 0.0)
    features, seen = {}, {}
    rng = np.random.default_rng(5)
    for index, pose in hilly.poses.items():
        pixels = CAMERA.project(pose.inverse().apply(points))
        inside = np.flatnonzero(((pixels > 0.0) & (pixels < (CAMERA.width, CAMERA.height))).all(axis=1))
        noisy = pixels[inside] + noise_px * rng.standard_normal((len(inside), 2))
        features[index] = replace(hilly.features[index], pixels=noisy.astype(np.float32))
        seen[index] = inside
    return replace(hilly, points=points, features=features, seen=seen)


def rebuilt(truth: Block, matches: dict[tuple[int, int], Int]) -> SparseModel | None:
    keys = dict.fromkeys(truth.poses, KEY)
    return local_sfm(truth.features, keys, {KEY: CAMERA}, frozenset({KEY}), matches)


def worst_centre(model: SparseModel, truth: Block) -> float:
    """The largest error of a camera centre after the best similarity, relative to the height."""
    placed = sorted(model.local_from_cam)
    local = np.array([model.local_from_cam[i].translation for i in placed])
    true = np.array([truth.poses[i].translation for i in placed])
    fit = weighted_similarity(local, true, np.ones(len(placed)))
    return float(np.linalg.norm(fit.apply(local) - true, axis=1).max()) / HEIGHT


def test_flat_ground_is_no_obstacle() -> None:
    truth = flat(noise_px=0.4)
    model = rebuilt(truth, matches_of(truth, most=300))
    assert model is not None and len(model.local_from_cam) == 12
    assert worst_centre(model, truth) < 0.01


@pytest.mark.parametrize("most", [25, 60])
def test_weakly_tied_images_are_placed_by_a_second_try(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """So few matches a pair that the usual demands place none, or a part."""
    truth = block(noise_px=0.4, n_points=180)
    matches = matches_of(truth, most)
    model = rebuilt(truth, matches)
    assert model is not None
    assert len(model.local_from_cam) >= 11
    assert worst_centre(model, truth) < 0.01
    monkeypatch.setattr(module, "_attempts", lambda *given: iter([module._pipeline_options()]))
    once = rebuilt(truth, matches)
    assert once is None or len(once.local_from_cam) < len(model.local_from_cam)


def test_a_model_that_holds_all_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = block(noise_px=0.4)
    made = []
    once = module._pipeline_options
    monkeypatch.setattr(module, "_pipeline_options", lambda: made.append(1) or once())
    model = rebuilt(truth, matches_of(truth))
    assert model is not None and len(model.local_from_cam) == 12 and len(made) == 1


def test_two_parts_give_the_larger_one() -> None:
    truth = block(rows=1, columns=9, noise_px=0.4)
    matches = {
        pair: found if (pair[0] < 6) == (pair[1] < 6) else found[:0] for pair, found in matches_of(truth).items()
    }
    model = rebuilt(truth, matches)
    assert model is not None and set(model.local_from_cam) == set(range(6))


def test_first_pairs_are_apart_and_share_no_image() -> None:
    truth = block(noise_px=0.4)
    pairs = module._first_pairs(truth.features, matches_of(truth))
    assert len(pairs) == module.MORE_STARTS
    assert len({i for pair in pairs for i in pair}) == 2 * len(pairs)
    for first, second in pairs:
        apart = np.linalg.norm(truth.poses[first].translation - truth.poses[second].translation)
        assert apart > 0.2 * HEIGHT


def test_no_matches_and_two_images_make_no_model() -> None:
    truth = block(noise_px=0.4)
    assert rebuilt(truth, {pair: found[:0] for pair, found in matches_of(truth).items()}) is None
    alone = {pair: found if pair == (0, 1) else found[:0] for pair, found in matches_of(truth).items()}
    assert rebuilt(truth, alone) is None
