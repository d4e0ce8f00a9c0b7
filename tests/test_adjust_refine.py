"""Refinement of a drifted map: cameras, lens and cloud come back to the truth, and nothing else is touched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.adjust.refine import refine
from onthefly3r.adjust.tracks import Tracks, chosen_tracks, joined_tracks
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_angle_deg, rotation_exp
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.records import CompactReference, Frame, NewFrame, Observations, Submap

SUBMAPS = ((0, 1, 2, 3), (4, 5, 6, 7), (8, 9, 10, 11))
BLIND = 11  # an image without observations


def observations(
    truth: synthetic.Block, images: list[int], local_from_map: Sim3, noise: float, seed: int
) -> Observations:
    rng = np.random.default_rng(seed)
    seen = {i: truth.seen[i] for i in images if i != BLIND}
    point = np.concatenate(list(seen.values()))
    kept, row = np.unique(point, return_inverse=True)
    return Observations(
        image=np.concatenate([np.full(len(s), i) for i, s in seen.items()]).astype(np.int32),
        feature=np.concatenate([np.arange(len(s)) for s in seen.values()]).astype(np.int32),
        pixel=np.concatenate([truth.features[i].pixels for i in seen]),
        point=row.astype(np.int32),
        points=local_from_map.apply(truth.points[kept] + noise * rng.standard_normal((len(kept), 3))).astype(
            np.float32
        ),
    )


def drifted_map(work: Path, truth: synthetic.Block, with_observations: bool = True) -> tuple[MapState, Store]:
    """Three strips as three submaps; each refers to the one before, and lies a little off in place and scale."""
    store = Store(work)
    state = MapState(store)
    state.set_spacing(0.1)
    rng = np.random.default_rng(7)
    camera = replace(synthetic.CAMERA, fx=812.0, fy=812.0, distortion=(0.0, 0.0, 0.0, 0.0))
    for number, images in enumerate(SUBMAPS):
        local_from_map = Sim3(1.0 / (20.0 + number), rotation_exp(rng.standard_normal(3)), rng.normal(0.0, 5.0, 3))
        drift = Sim3(
            1.0 + 0.01 * number, rotation_exp(np.radians(0.5 * number) * np.eye(3)[number % 3]), np.full(3, 0.3)
        )
        frames = []
        for index in images:
            pose = truth.poses[index]
            off = Rigid3(
                pose.rotation @ rotation_exp(0.003 * rng.standard_normal(3)), pose.translation + rng.normal(0.0, 0.1, 3)
            )
            frame = Frame(index, number, camera, PixelMap(), local_from_map.apply_to_pose(off), 1.0)
            points = local_from_map.apply(truth.points[truth.seen[index]]).astype(np.float32)
            reference = CompactReference(
                np.zeros((0, 2), np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
            )
            colours = np.zeros((len(points), 3), np.uint8)
            frames.append(NewFrame(frame, reference, points, colours, np.full(len(points), 255, np.uint8)))
        map_from_submap = drift @ local_from_map.inverse()
        submap = Submap(
            number, map_from_submap, tuple(new.frame for new in frames), (), calibrations={synthetic.KEY: camera}
        )
        seen = observations(
            truth, [i for s in SUBMAPS[max(0, number - 1) : number + 1] for i in s], local_from_map, 0.1, number
        )
        state.commit(submap, frames, seen if with_observations else None)
    return state, store


def errors(state: MapState, truth: synthetic.Block) -> tuple[float, float]:
    """RMS of the camera centres and of the angles (deg) after the best similarity."""
    images = [i for i in sorted(truth.poses) if i != BLIND]
    centres = np.array([state.map_from_cam(i).translation for i in images])
    true = np.array([truth.poses[i].translation for i in images])
    fit = weighted_similarity(centres, true, np.ones(len(true)))
    turn = [
        rotation_angle_deg(fit.rotation @ state.map_from_cam(i).rotation @ truth.poses[i].rotation.T) for i in images
    ]
    return float(np.sqrt(((fit.apply(centres) - true) ** 2).sum(axis=1).mean())), float(
        np.sqrt(np.mean(np.square(turn)))
    )


def cloud_error(state: MapState, store: Store, truth: synthetic.Block) -> float:
    """Median distance of the stored points from the truth, after the similarity that fits the cameras."""
    images = sorted(truth.poses)
    centres = np.array([state.map_from_cam(i).translation for i in images])
    fit = weighted_similarity(centres, np.array([truth.poses[i].translation for i in images]), np.ones(len(images)))
    distances = []
    for stored in store.stream_points():
        points = fit.apply(state.submap_pose_of(stored.index).apply(stored.points.astype(float)))
        distances.append(np.linalg.norm(points - truth.points[truth.seen[stored.index]], axis=1))
    return float(np.median(np.concatenate(distances)))


@pytest.fixture(scope="module")
def truth() -> synthetic.Block:
    return synthetic.block(noise_px=0.3, n_points=1500)


def test_drift_and_lens_are_removed_and_the_cloud_follows(tmp_path: Path, truth: synthetic.Block) -> None:
    """From half a metre to below a decimetre at 50 m; noise 0.3 px, twelve images, the lens unknown."""
    state, store = drifted_map(tmp_path, truth)
    before, cloud_before = errors(state, truth), cloud_error(state, store, truth)
    refined = refine(state, store.stream_observations(), synthetic.shots(truth))
    assert refined is not None
    assert errors(state, truth) == before  # the map is only read
    state.move_refined(refined.map_from_submap, refined.calibrations)
    after = errors(state, truth)
    assert before[0] > 0.3 and after[0] < 0.1
    assert before[1] > 0.2 and after[1] < 0.15
    assert cloud_error(state, store, truth) < 0.5 * cloud_before
    assert abs(np.log(refined.calibrations[synthetic.KEY].fx / 800.0)) < 0.01
    assert refined.notes["reprojection_after_px"] < 0.5 < refined.notes["reprojection_before_px"]


def test_an_image_without_observations_follows_its_neighbour(tmp_path: Path, truth: synthetic.Block) -> None:
    state, store = drifted_map(tmp_path, truth)
    refined = refine(state, store.stream_observations(), synthetic.shots(truth))
    assert refined is not None and refined.notes["refined_images"] == 11
    nearest = refined.map_from_submap[10] @ state.submap_pose_of(10).inverse()
    own = refined.map_from_submap[BLIND] @ state.submap_pose_of(BLIND).inverse()
    assert np.allclose(own.matrix(), nearest.matrix())


def test_a_refined_map_is_read_again(tmp_path: Path, truth: synthetic.Block) -> None:
    state, store = drifted_map(tmp_path, truth)
    refined = refine(state, store.stream_observations(), synthetic.shots(truth))
    assert refined is not None
    state.move_refined(refined.map_from_submap, refined.calibrations)
    again = MapState.load(Store(tmp_path))
    assert again.calibrations == state.calibrations
    for index in truth.poses:
        assert np.allclose(again.map_from_cam(index).matrix(), state.map_from_cam(index).matrix())


def test_nothing_to_refine_without_observations(tmp_path: Path, truth: synthetic.Block) -> None:
    state, store = drifted_map(tmp_path, truth, with_observations=False)
    assert refine(state, store.stream_observations(), synthetic.shots(truth)) is None


def test_features_join_submaps_and_contradictions_are_left_out(tmp_path: Path, truth: synthetic.Block) -> None:
    state, store = drifted_map(tmp_path, truth)
    joined = joined_tracks(state, store.stream_observations())
    seen_by = {k: {int(i) for i in joined.image[joined.point == k]} for k in range(0, len(joined.points), 50)}
    assert any(len({state.frames[i].submap for i in images}) == 3 for images in seen_by.values())
    key = joined.image.astype(np.int64) * len(joined.points) + joined.point
    assert len(np.unique(key)) == len(key)

    found = list(store.stream_observations())
    number, first = found[0]
    of_one_image = first.point[first.image == first.image[0]]
    one, other = of_one_image[np.bincount(first.point)[of_one_image] >= 3][:2]
    double = replace(first, point=np.where(first.point == other, one, first.point))
    spoilt = joined_tracks(state, [(number, double), *found[1:]])
    assert len(spoilt.points) == len(joined.points) - 2  # the two points that were joined by mistake


def test_long_tracks_spread_over_the_image_are_chosen() -> None:
    """A cell full of pairs and one long track in another: the long one stays, and some pairs."""
    pairs = 30_000
    image = np.concatenate([np.tile([0, 1], pairs), np.arange(10)])
    point = np.concatenate([np.repeat(np.arange(pairs), 2), np.full(10, pairs)])
    pixel = np.concatenate([np.full((2 * pairs, 2), 10.0), np.full((10, 2), 590.0)])
    tracks = Tracks(image, pixel, np.full(len(image), np.nan), point, np.zeros((pairs + 1, 3)))
    chosen = chosen_tracks(tracks, dict.fromkeys(range(10)))
    counts = np.bincount(chosen.image)
    assert counts[0] == 112  # 40,000 observations over 10 images of 36 cells are 111 pairs, and the long track
    assert len(counts) == 2  # the others keep a single observation, too few to move them


def test_mismatches_and_points_behind_a_camera_do_no_harm(tmp_path: Path, truth: synthetic.Block) -> None:
    """A twentieth of the observations are at random pixels, and some points were triangulated above the cameras."""
    state, store = drifted_map(tmp_path, truth)
    rng = np.random.default_rng(4)
    spoilt = []
    for number, found in store.stream_observations():
        wrong = rng.random(len(found.image)) < 0.05
        pixel = np.where(wrong[:, None], rng.uniform((0, 0), (1000, 750), found.pixel.shape), found.pixel)
        above = rng.random(len(found.points)) < 0.02
        up = state.map_from_submap[number].inverse().apply(np.array([0.0, 0.0, 500.0]))
        points = np.where(above[:, None], up, found.points)
        spoilt.append((number, replace(found, pixel=pixel.astype(np.float32), points=points.astype(np.float32))))
    refined = refine(state, spoilt, synthetic.shots(truth))
    assert refined is not None
    state.move_refined(refined.map_from_submap, refined.calibrations)
    assert errors(state, truth)[0] < 0.15
