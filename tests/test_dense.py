"""Dense point maps: against the truth of rendered photographs, and each rule on made-up depth maps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import pytest

from onthefly3r.backbones import dense
from onthefly3r.backbones.dense import DenseView, choose_partners, dense_view, dense_views, sparse_view
from onthefly3r.backbones.local_sfm import SparseModel, Track
from onthefly3r.backbones.stereo import disparity
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from onthefly3r.records import Features
from onthefly3r.simulate import Survey, SurveyOptions, plan_survey
from onthefly3r.simulate.photographs import render

GRID = (300, 225)
NEW = (1, 2, 5, 6)  # two of each strip; the drone flies the second strip the other way


def features_at(pixels: np.ndarray) -> Features:
    count = len(pixels)
    nothing = np.zeros(count, np.float32)
    return Features(pixels.astype(np.float32), nothing, nothing, np.zeros((count, 128), np.uint8))


@dataclass(frozen=True)
class Case:
    survey: Survey
    images: dict[int, np.ndarray]
    model: SparseModel
    keys: dict[int, str]
    features: dict[int, Features]
    views: dict[int, DenseView]

    def depth_errors_gsd(self, index: int) -> np.ndarray:
        """(H, W) absolute depth errors in ground sampling distances of the working image."""
        view = self.survey.views[index]
        grid = view.camera.resized(*GRID)
        truth = self.survey.scene.view(grid, view.enu_from_cam, grid.pixel_centres()).distances.reshape(GRID[::-1])
        depth = view.enu_from_cam.inverse().apply(self.views[index].points)[..., 2]
        return np.abs(depth - truth) * view.camera.fx / truth


def true_model(survey: Survey, points_per_image: int = 150) -> tuple[SparseModel, dict[int, Features]]:
    """What structure from motion would answer: true poses, and points of the surface at whole keypoints."""
    rng = np.random.default_rng(3)
    scene, views = survey.scene, survey.views
    size = (views[0].camera.width, views[0].camera.height)
    points = np.concatenate(
        [scene.view(v.camera, v.enu_from_cam, rng.uniform((0, 0), size, (points_per_image, 2))).points for v in views]
    )
    length, tracks, features = np.zeros(len(points), int), {}, {}
    for index, view in enumerate(views):
        in_camera = view.enu_from_cam.inverse().apply(points)
        pixels = view.camera.project(in_camera)
        inside = ((pixels > 0.0) & (pixels < size)).all(axis=-1)
        hit = scene.view(view.camera, view.enu_from_cam, np.where(inside[:, None], pixels, 1.0)).distances
        seen = np.flatnonzero(inside & (np.abs(hit - in_camera[:, 2]) < 0.05))
        tracks[index] = Track(np.arange(len(seen)), seen)
        features[index] = features_at(pixels[seen])
        length[seen] += 1
    poses = {index: view.enu_from_cam for index, view in enumerate(views)}
    return SparseModel(poses, {"a": views[0].camera}, points, np.full(len(points), 0.3), length, tracks, 0.3), features


@pytest.fixture(scope="module")
def case() -> Case:
    """Two strips of four photographs, 600 x 450, through a distorting lens."""
    survey = plan_survey(
        SurveyOptions(images=8, strips=2, image_width_px=600, image_height_px=450, distorted=True, seed=1)
    )
    images = {index: render(survey.scene, view) for index, view in enumerate(survey.views)}
    model, features = true_model(survey)
    keys = dict.fromkeys(images, "a")
    views = dense_views(NEW, images, model, keys, features, dict.fromkeys(NEW, GRID))
    return Case(survey, images, model, keys, features, views)


def test_exported_points_are_accurate_and_many(case: Case) -> None:
    """Mean distance to the surface within one ground sampling distance; 80 % of the pixels, few gross errors."""
    assert sorted(case.views) == sorted(NEW)
    for index, view in case.views.items():
        good = view.confidence >= 0.5
        assert good.mean() > 0.8
        errors = case.depth_errors_gsd(index)[good]
        assert np.median(errors) < 0.5
        assert (errors > 6.0).mean() < 0.01  # about 1.5 % of the distance
        points = view.points[good][::25]
        camera = case.survey.views[index]
        gsd_m = camera.enu_from_cam.translation[2] / camera.camera.fx
        assert case.survey.scene.distance_to_surface(points).mean() < 1.0 * gsd_m


def test_error_falls_as_confidence_rises(case: Case) -> None:
    confidence = np.concatenate([view.confidence.ravel() for view in case.views.values()])
    error = np.concatenate([case.depth_errors_gsd(index).ravel() for index in case.views])
    edges = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    bins = [(confidence > low) & (confidence <= high) for low, high in pairwise(edges)]
    assert min(chosen.sum() for chosen in bins) > 300
    means = [float(error[chosen].mean()) for chosen in bins]
    assert means == sorted(means, reverse=True), means
    assert means[0] > 20.0 * means[-1]


def test_maps_keep_their_contract(case: Case) -> None:
    """Points project into their own pixels; confidences are 0..1 and 0 just where the points are NaN."""
    grid = case.survey.views[0].camera.resized(*GRID)
    for index, view in case.views.items():
        assert view.points.shape == (*GRID[::-1], 3)
        assert view.points.dtype == view.confidence.dtype == np.float32
        known = np.isfinite(view.points).all(axis=-1)
        assert (np.isnan(view.points).all(axis=-1) == ~known).all()
        assert ((view.confidence > 0.0) == known).all()
        assert view.confidence.max() <= 1.0
        in_camera = case.model.local_from_cam[index].inverse().apply(view.points[known])
        offset = np.abs(grid.project(in_camera) - grid.pixel_centres()[known]).max(axis=-1)
        assert offset.max() <= 0.5 + 1e-2  # sparse points keep their own places
        assert np.median(offset) < 1e-3


def test_same_answer_whatever_the_threads(case: Case) -> None:
    again = dense_views(
        NEW[:2], case.images, case.model, case.keys, case.features, dict.fromkeys(NEW[:2], GRID), threads=1
    )
    twice = dense_views(
        NEW[:2], case.images, case.model, case.keys, case.features, dict.fromkeys(NEW[:2], GRID), threads=3
    )
    for index in again:
        np.testing.assert_array_equal(again[index].points, twice[index].points)
        np.testing.assert_array_equal(again[index].confidence, twice[index].confidence)


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_photograph_may_be_turned_in_its_plane(case: Case, quarter_turns: int) -> None:
    """The partners of image 1 lie along its short side; turned by 90 degrees they lie along its long one."""
    camera = dataclasses.replace(case.model.cameras["a"], distortion=(0.0, 0.0, 0.0, 0.0))
    images = {i: render(case.survey.scene, dataclasses.replace(case.survey.views[i], camera=camera)) for i in (1, 2)}
    straight = {**case.model.cameras, "a": camera}
    turned_camera = camera
    for _ in range(quarter_turns):  # counter-clockwise, as np.rot90: (x, y) goes to (y, width - x)
        turned_camera = Camera(
            turned_camera.height,
            turned_camera.width,
            turned_camera.fy,
            turned_camera.fx,
            turned_camera.cy,
            turned_camera.width - turned_camera.cx,
        )
    cam_from_turned = Rigid3(rotation_exp(np.array([0.0, 0.0, np.pi / 2 * quarter_turns])))
    model = dataclasses.replace(
        case.model,
        cameras={**straight, "turned": turned_camera},
        local_from_cam={1: case.model.local_from_cam[1] @ cam_from_turned, 2: case.model.local_from_cam[2]},
    )
    images[1] = np.ascontiguousarray(np.rot90(images[1], quarter_turns))
    grid = GRID if quarter_turns == 2 else GRID[::-1]
    view = dense_view(1, images, model, {1: "turned", 2: "a"}, grid)
    upright = dense_view(
        1,
        {1: np.ascontiguousarray(np.rot90(images[1], -quarter_turns)), 2: images[2]},
        dataclasses.replace(model, local_from_cam={i: case.model.local_from_cam[i] for i in (1, 2)}),
        {1: "a", 2: "a"},
        GRID,
    )
    back = np.rot90(view.points, -quarter_turns)
    both = np.isfinite(back).all(axis=-1) & np.isfinite(upright.points).all(axis=-1)
    assert both.mean() > 0.7
    assert np.median(np.linalg.norm((back - upright.points)[both], axis=-1)) < 0.02  # metres, from 80


def test_featureless_images_export_nothing(case: Case) -> None:
    """Noise on even grey, as of water or sky: whatever is matched there must not reach 0.5."""
    rng = np.random.default_rng(5)
    shape = case.images[0].shape
    images = {i: np.clip(128 + 2.0 * rng.standard_normal(shape), 0, 255).astype(np.uint8) for i in case.images}
    nowhere = {i: features_at(np.full_like(f.pixels, -9.0)) for i, f in case.features.items()}
    views = dense_views((1, 2), images, case.model, case.keys, nowhere, {1: GRID, 2: GRID})
    assert max((view.confidence >= 0.5).mean() for view in views.values()) < 0.002


def test_unlike_images_hardly_match() -> None:
    first, second = np.random.default_rng(5).integers(60, 190, (2, 240, 320), np.uint8)
    found, sigma = disparity(first, second, 64)
    assert np.isfinite(found).mean() < 0.02
    assert sigma.shape == found.shape == (240, 320)


@pytest.mark.parametrize("shift_px", [7.0, 20.4, 33.75])
def test_disparity_to_a_fraction_of_a_pixel(shift_px: float) -> None:
    """One texture sampled twice, brighter and flatter in the right image; 0.05 px off in the median, bias included."""
    rng = np.random.default_rng(2)
    fine = cv2.GaussianBlur(rng.standard_normal((240, 4 * 400)).astype(np.float32), (0, 0), 6.0, sigmaY=1.5)
    fine = 128.0 + 40.0 * fine / fine.std()
    x, y = np.meshgrid(np.arange(320, dtype=np.float32), np.arange(240, dtype=np.float32))
    left, right = (cv2.remap(fine, 4.0 * (x + start), y, cv2.INTER_CUBIC) for start in (0.0, shift_px))
    noisy = [image + 2.0 * rng.standard_normal(image.shape) for image in (left, 20.0 + 0.8 * right)]
    images = [np.clip(image, 1, 255).astype(np.uint8) for image in noisy]
    found, sigma = disparity(images[0], images[1], 64)
    error = found[10:-10, 80:-10] - shift_px
    assert np.isfinite(error).mean() > 0.95
    assert np.nanmedian(np.abs(error)) < 0.05
    assert 0.3 < np.nanstd(error) / (dense.SIGMA_FACTOR * np.median(sigma[10:-10, 80:-10])) < 1.5


def test_unplaced_images_are_left_out_and_lonely_ones_are_empty(case: Case) -> None:
    alone = dataclasses.replace(
        case.model,
        local_from_cam={1: case.model.local_from_cam[1]},
        tracks={1: Track(np.zeros(0, int), np.zeros(0, int))},
    )
    views = dense_views((1, 2), case.images, alone, case.keys, case.features, {1: GRID, 2: GRID})
    assert list(views) == [1]
    assert np.isnan(views[1].points).all()
    assert not views[1].confidence.any()


def test_map_holds_the_sparse_points_themselves(case: Case) -> None:
    index = NEW[0]
    sparse = sparse_view(index, case.model, case.keys, case.features[index], GRID)
    chosen = sparse.confidence > 0.0
    assert chosen.sum() > 200
    np.testing.assert_array_equal(case.views[index].points[chosen], sparse.points[chosen])
    np.testing.assert_array_equal(case.views[index].confidence[chosen], sparse.confidence[chosen])


CAMERA = Camera(100, 80, 100.0, 100.0, 50.0, 40.0)


def row_of_cameras(points: np.ndarray, positions: list[float], **changes: np.ndarray) -> SparseModel:
    """Cameras that look along z from places along x; each sees every point as the feature of its number."""
    count = len(points)
    table = {
        "points": points,
        "reprojection_px": np.full(count, 0.3),
        "track_length": np.full(count, len(positions)),
        **changes,
    }
    track = Track(np.arange(count), np.arange(count))
    return SparseModel(
        local_from_cam={i: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for i, x in enumerate(positions)},
        cameras={"a": CAMERA},
        tracks=dict.fromkeys(range(len(positions)), track),
        mean_reprojection_px=0.3,
        **table,
    )


def test_sparse_point_lies_in_the_pixel_of_its_keypoint() -> None:
    # pixels (60, 44), (60.4, 44.6) and (20, 40) of the image; the first two share the pixel (30, 22) of the map
    points = np.array([[1.0, 0.4, 10.0], [1.04, 0.46, 10.0], [-3.0, 0.0, 10.0]])
    model = row_of_cameras(points, [0.0, 2.0, -2.0])
    pixels = CAMERA.project(points)
    view = sparse_view(0, model, dict.fromkeys(range(3), "a"), features_at(pixels), (50, 40))
    np.testing.assert_array_equal(view.points[22, 30], points[0].astype(np.float32))  # the lower index
    np.testing.assert_array_equal(view.points[20, 10], points[2].astype(np.float32))
    assert (view.confidence > 0.0).sum() == 2
    assert np.isnan(view.points[view.confidence == 0.0]).all()


def test_sparse_point_that_projects_elsewhere_is_left_out() -> None:
    points = np.array([[1.0, 0.4, 10.0], [-3.0, 0.0, 10.0], [2.0, 1.0, 10.0]])
    model = row_of_cameras(points, [0.0, 2.0, -2.0])
    pixels = CAMERA.project(points) + np.array([(0.0, 0.0), (2.9, 0.0), (1.2, 0.0)])
    pixels[2, 0] += 200.0  # outside of the image
    view = sparse_view(0, model, dict.fromkeys(range(3), "a"), features_at(pixels), (50, 40))
    assert np.argwhere(view.confidence > 0.0).tolist() == [[22, 30]]


def test_sparse_confidence_follows_angle_error_and_track_length() -> None:
    points = np.array([[0.1 * k, 0.0, 10.0] for k in range(-5, 6)])
    keys = dict.fromkeys(range(4), "a")

    def confidence(positions: list[float], **changes: np.ndarray) -> float:
        model = row_of_cameras(points, positions, **changes)
        view = sparse_view(0, model, keys, features_at(CAMERA.project(points)), (50, 40))
        return float(np.median(view.confidence[view.confidence > 0.0]))

    usual = confidence([0.0, 2.0, -2.0])
    assert usual > 0.4  # 0.58 px over angles of 11 degrees: 2 ground sampling distances
    assert confidence([0.0, 0.4, -0.4]) < 0.5 * usual  # 2 degrees
    assert confidence([0.0, 2.0, -2.0], reprojection_px=np.full(11, 2.0)) < 0.7 * usual
    # a mismatch along the ray is not seen by two images
    assert confidence([0.0, 2.0, -2.0], track_length=np.full(11, 2)) == pytest.approx(usual * 0.5 / 0.75)
    assert usual < confidence([0.0, 2.0, -2.0, 3.0]) <= 1.0


def test_partners_have_a_good_angle_and_cover_what_others_do_not() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-3.0, -2.0, 9.0), (3.0, 2.0, 11.0), (200, 3))
    positions = [0.0, 0.3, 2.5, 2.7, 3.6]  # 2, 14, 15 and 20 degrees
    model = row_of_cameras(points, positions)
    assert choose_partners(0, model, 1) == [2]
    left = Track(*(2 * (np.flatnonzero(points[:, 0] < 0.3),)))
    right = Track(*(2 * (np.flatnonzero(points[:, 0] >= 0.3),)))
    split = dataclasses.replace(model, tracks={**model.tracks, 1: right, 2: left, 3: left, 4: right})
    best, second = choose_partners(0, split, 2)
    assert best in (2, 3)  # alike, and each alone is worth more than image 4
    assert second == 4
    few = Track(np.arange(5), np.arange(5))
    assert choose_partners(0, dataclasses.replace(model, tracks=dict.fromkeys(range(5), few)), 2) == []


def test_partners_that_agree_are_averaged_others_are_doubted() -> None:
    nan = np.nan
    depths = [np.array([[10.0, 10.0, nan, nan]], np.float32), np.array([[10.02, 12.0, 9.0, nan]], np.float32)]
    sigmas = [np.full((1, 4), 0.01, np.float32), np.full((1, 4), 0.02, np.float32)]
    merged = dense.merge_depths(depths, sigmas, 1000.0)
    np.testing.assert_allclose(merged.depth, [[10.004, 10.0, 9.0, nan]], rtol=1e-6)
    np.testing.assert_allclose(merged.sigma[0, :3], [0.01 / np.sqrt(1.25), 0.01, 0.02], rtol=1e-5)
    agreed, disputed, alone, unknown = merged.trust[0]
    assert agreed > alone > 0.5 > disputed > unknown == 0.0


def test_confidence_is_trust_times_precision() -> None:
    model = row_of_cameras(np.array([[0.0, 0.0, 10.0]]), [0.0])
    depth, trust = np.full((80, 100), 10.0, np.float32), np.full((80, 100), 0.7, np.float32)
    gsd = 10.0 / CAMERA.fx
    for sigma_gsd, expected in ((0.0, 0.7), (2.5, 0.35), (250.0, 0.0)):
        depth_map = dense.DepthMap(depth, np.full_like(depth, sigma_gsd * gsd), trust)
        view = dense._to_view(0, depth_map, model, {0: "a"})
        np.testing.assert_allclose(view.confidence, expected, atol=1e-3)
        np.testing.assert_allclose(view.points[..., 2], 10.0, rtol=1e-6)


def test_other_views_confirm_and_contradict() -> None:
    """A wall at depth 10 with one blob floating before it and one behind it: the wall's other image looks through."""
    rng = np.random.default_rng(0)
    model = row_of_cameras(rng.uniform((-3.0, -2.0, 10.0), (3.0, 2.0, 10.0), (50, 3)), [0.0, 1.0])
    wall = np.full((80, 100), 10.0, np.float32)
    sigma, trust = np.full_like(wall, 0.01), np.full_like(wall, 0.7)
    spoilt = wall.copy()
    spoilt[40:44, 50:54], spoilt[20:24, 50:54] = 8.0, 12.0
    maps = {0: dense.DepthMap(spoilt, sigma, trust), 1: dense.DepthMap(wall, sigma, trust)}
    checked = dense._cross_check(0, maps, model, {0: "a", 1: "a"})
    np.testing.assert_array_equal(checked.depth, spoilt)
    assert (checked.trust[40:44, 50:54] < 0.3).all()
    np.testing.assert_array_equal(checked.trust[20:24, 50:54], trust[20:24, 50:54])  # may be hidden from there
    assert (checked.trust[60:70, 50:60] > 0.8).all()
    np.testing.assert_array_equal(checked.trust[:, 0:5], trust[:, 0:5])  # beyond the edge of the other image
