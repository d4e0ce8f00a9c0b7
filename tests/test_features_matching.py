"""Verified matches on two views of points whose matches are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from onthefly3r.features.epipolar import guided_neighbours, relative_geometry
from onthefly3r.features.matching import MAX_MATCHES, PairMatcher, Side, mutual_matches, verified_matches
from onthefly3r.geometry.arrays import Float, Int
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.records import Features

CAMERA = Camera(1000, 750, 800.0, 800.0, 500.0, 375.0, (-0.05, 0.01, 0.0, 0.0))
ALTITUDE_M = 100.0


def turned(yaw_deg: float, tilt_deg: float = 0.0) -> Float:
    """A camera that looks down, turned about its axis and then tilted."""
    yaw, tilt = np.radians(yaw_deg), np.radians(tilt_deg)
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
    return np.asarray(about_x @ about_z)


MOTIONS = {
    "beside": Rigid3(turned(3.0), np.array([18.0, 2.0, 0.5])),
    "next strip, flown back": Rigid3(turned(178.0, 4.0), np.array([2.0, 25.0, 1.0])),
    "forward, the epipole in the image": Rigid3(turned(20.0), np.array([1.0, -2.0, 25.0])),
    "oblique": Rigid3(turned(60.0, 25.0), np.array([0.0, 40.0, 10.0])),
}


def two_views(
    ground_from_second: Rigid3,
    relief_m: float,
    seed: int = 0,
    points: int = 4000,
    camera: Camera = CAMERA,
    alike: int = 1,
    half_m: float = 90.0,
) -> tuple[Features, Features, dict[int, int]]:
    """Features of a ground 100 m below the first camera, and which feature of the second each one of the first is.

    Half a pixel of noise, descriptors as noisy as real ones, a third of the features seen by one image only; each
    descriptor occurs at `alike` places.
    """
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-half_m, half_m, (points, 2)), np.full(points, ALTITUDE_M)])
    ground[:, 2] += rng.uniform(-relief_m, relief_m, points)
    vectors = np.tile(rng.exponential(1.0, (points // alike + 1, 128)), (alike, 1))[:points]
    size = rng.uniform(0.1, 0.5, points)
    direction = rng.uniform(0.0, 2.0 * np.pi, points)
    views, names = [], []
    for ground_from_cam in (Rigid3(np.eye(3), np.zeros(3)), ground_from_second):
        local = ground_from_cam.inverse().apply(ground)
        pixels = camera.project(local) + rng.normal(size=(points, 2)) * 0.5
        visible = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1) & (rng.random(points) < 0.8)
        own = rng.permutation(np.flatnonzero(visible))
        heading = np.arctan2(ground_from_cam.rotation[1, 0], ground_from_cam.rotation[0, 0])
        noisy = np.sqrt(np.maximum(vectors[own] + 0.35 * rng.normal(size=(len(own), 128)), 0.0))
        noisy *= 512.0 / np.linalg.norm(noisy, axis=1, keepdims=True)
        views.append(
            Features(
                pixels[own].astype(np.float32),
                (size[own] * camera.fx / local[own, 2] * rng.uniform(0.95, 1.05, len(own))).astype(np.float32),
                (direction[own] - heading + 0.05 * rng.normal(size=len(own))).astype(np.float32),
                np.rint(noisy).clip(0, 255).astype(np.uint8),
            )
        )
        names.append(own)
    where = {int(name): row for row, name in enumerate(names[1])}
    truth = {row: where[int(name)] for row, name in enumerate(names[0]) if int(name) in where}
    return views[0], views[1], truth


def right(matches: Int, truth: dict[int, int]) -> int:
    return sum(truth.get(int(a)) == int(b) for a, b in matches)


@pytest.mark.parametrize("relief_m", [0.0, 2.0, 20.0])
@pytest.mark.parametrize("motion", MOTIONS)
def test_matches_are_right_and_as_many_as_wanted(motion: str, relief_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also over perfectly flat ground, where two essential matrices explain the same plane."""
    first, second, truth = two_views(MOTIONS[motion], relief_m)
    sides = Side(first, CAMERA), Side(second, CAMERA)
    capped = verified_matches(*sides, band_px=1.0)
    assert len(capped) == min(MAX_MATCHES, len(capped)) and right(capped, truth) > 0.99 * len(capped)
    assert len(capped) > 0.5 * min(MAX_MATCHES, len(truth))
    monkeypatch.setattr("onthefly3r.features.matching.MAX_MATCHES", 100_000)
    every = verified_matches(*sides, band_px=3.0)
    assert right(every, truth) > 0.99 * len(every)
    assert right(every, truth) > 0.8 * len(truth)
    assert len(np.unique(every[:, 0])) == len(np.unique(every[:, 1])) == len(every)


def test_guided_matching_finds_what_repeats_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of one crop: every descriptor occurs twice, so that no match is clear until its plane is known."""
    monkeypatch.setattr("onthefly3r.features.matching.MAX_MATCHES", 100_000)
    first, second, truth = two_views(MOTIONS["beside"], 10.0, points=1500, alike=2, half_m=40.0)
    # A few that are unlike all others tell the geometry.
    some_first, some_second, some = two_views(MOTIONS["beside"], 10.0, seed=5, points=600)
    joined = [
        Features(
            *(
                np.concatenate([getattr(a, name), getattr(b, name)])
                for name in ("pixels", "scales", "angles", "descriptors")
            )
        )
        for a, b in ((some_first, first), (some_second, second))
    ]
    shift = len(some_first.pixels), len(some_second.pixels)
    truth = some | {a + shift[0]: b + shift[1] for a, b in truth.items()}
    assert len(mutual_matches(*joined)) < 0.5 * len(truth)
    found = verified_matches(Side(joined[0], CAMERA), Side(joined[1], CAMERA), band_px=1.0)
    assert right(found, truth) > 0.6 * len(truth)
    assert right(found, truth) > 0.97 * len(found)


def test_a_wrong_prior_keeps_matches_all_over_the_image() -> None:
    """A focal length 4 % off and no word of the distortion: the wide band keeps what lies in the corners."""
    first, second, truth = two_views(MOTIONS["beside"], 5.0)
    prior = replace(CAMERA, fx=1.04 * CAMERA.fx, fy=1.04 * CAMERA.fy, distortion=(0.0, 0.0, 0.0, 0.0))
    found = verified_matches(Side(first, prior), Side(second, prior), band_px=3.0)
    assert len(found) == MAX_MATCHES and right(found, truth) > 0.98 * len(found)
    cells = np.unique((first.pixels[found[:, 0]] // 125).astype(int), axis=0)
    seen = np.unique((first.pixels[list(truth)] // 125).astype(int), axis=0)
    assert len(cells) > 0.9 * len(seen)


def test_images_of_two_places_have_no_matches() -> None:
    first, _, _ = two_views(MOTIONS["beside"], 5.0, seed=1)
    _, second, _ = two_views(MOTIONS["beside"], 5.0, seed=2)
    assert len(verified_matches(Side(first, CAMERA), Side(second, CAMERA), band_px=3.0)) == 0
    nothing = Features(
        np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros((0, 128), np.uint8)
    )
    for pair in ((nothing, first), (first, nothing), (nothing, nothing)):
        assert verified_matches(Side(pair[0], CAMERA), Side(pair[1], CAMERA), band_px=3.0).shape == (0, 2)


def test_a_weak_pair_is_looked_at_with_all_features() -> None:
    """A tenth of overlap: among the first thousand features too few match."""
    motion = Rigid3(turned(0.0), np.array([112.0, 0.0, 0.0]))
    first, second, truth = two_views(motion, 5.0, points=6000)
    found = verified_matches(Side(first, CAMERA), Side(second, CAMERA), band_px=1.0)
    assert len(truth) > 100
    assert right(found, truth) > 0.7 * len(truth) and right(found, truth) > 0.97 * len(found)


def test_neighbours_in_a_plane_are_those_that_comparing_all_with_all_finds() -> None:
    for motion in MOTIONS.values():
        first, second, truth = two_views(motion, 5.0, seed=3, points=900)
        sides = Side(first, CAMERA), Side(second, CAMERA)
        matches = np.array(list(truth.items()))
        geometry = relative_geometry(
            sides[0].rays[matches[:, 0]], sides[1].rays[matches[:, 1]], CAMERA.fx, 2.0, min_inliers=15
        )
        assert geometry is not None
        band = 2.0 / CAMERA.fx
        rows, best, products, second_best = guided_neighbours(
            geometry.matrix, sides[0].rays, sides[1].rays, sides[0].vectors, sides[1].vectors, band
        )
        planes = sides[0].rays @ geometry.matrix.T
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        rays = sides[1].rays / np.linalg.norm(sides[1].rays, axis=1, keepdims=True)
        off = np.abs(planes @ rays.T)
        table = np.where(off <= band, sides[0].vectors @ sides[1].vectors.T, -np.inf)
        wanted = np.flatnonzero(
            np.isfinite(table.max(axis=1)) & (table.max(axis=1) >= table.max(axis=0)[table.argmax(axis=1)])
        )
        # Rounding decides where a ray lies at the edge of its band; near the epipole all planes are one.
        same = np.intersect1d(rows, wanted)
        assert len(same) > 0.98 * len(wanted) and len(same) > 0.98 * len(rows)
        agreed = np.isin(rows, same)
        assert np.mean(best[agreed] == table.argmax(axis=1)[rows[agreed]]) > 0.99
        assert np.mean(products[agreed] == table.max(axis=1)[rows[agreed]]) > 0.99
        table[np.arange(len(table)), table.argmax(axis=1)] = -np.inf
        assert np.mean(second_best[agreed] == table.max(axis=1)[rows[agreed]]) > 0.97


def test_matches_do_not_depend_on_the_number_of_threads() -> None:
    views = [two_views(motion, 5.0)[1] for motion in MOTIONS.values()]
    features = dict(enumerate(views))
    cameras = dict.fromkeys(features, CAMERA)
    found = [
        PairMatcher(threads).match(features, cameras, dict.fromkeys(features, True), tuple(features))
        for threads in (1, 4)
    ]
    assert set(found[0]) == set(found[1]) and len(found[0]) == 6
    for pair, matches in found[0].items():
        assert np.array_equal(matches, found[1][pair])
    assert sum(len(matches) > 0 for matches in found[0].values()) >= 4


def test_mutual_matches_are_the_same_from_either_side() -> None:
    first, second, truth = two_views(MOTIONS["oblique"], 5.0)
    matches = mutual_matches(first, second)
    assert right(matches, truth) > 0.95 * len(matches) and len(matches) > 0.8 * len(truth)
    assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)
    agreed = {tuple(pair) for pair in matches.tolist()} & {(b, a) for a, b in mutual_matches(second, first).tolist()}
    assert len(agreed) > 0.9 * len(matches)


def test_a_thorough_comparison_keeps_more() -> None:
    first, second, truth = two_views(MOTIONS["beside"], 5.0, points=6000)
    usual, thorough = (verified_matches(Side(first, CAMERA), Side(second, CAMERA), 1.0, how) for how in (False, True))
    assert len(usual) == MAX_MATCHES and len(thorough) == 2 * MAX_MATCHES
    assert right(thorough, truth) > 0.99 * len(thorough)
