"""The classical backbone on rendered photographs: what every backbone promises, and what only this one does."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.backbones.classical import ClassicalBackbone
from onthefly3r.features import matching
from onthefly3r.features.extraction import FeatureStore
from onthefly3r.features.matching import PairMatcher
from onthefly3r.geometry.camera import Camera, PixelMap
from onthefly3r.geometry.transforms import Sim3, rotation_angle_deg
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.options import BackboneOptions
from onthefly3r.records import LocalModel, Rejection, Subset, WorkingImage
from onthefly3r.simulate import Survey, SurveyOptions, plan_survey
from onthefly3r.simulate.oracle import oracle_shots
from onthefly3r.simulate.photographs import render

NEW = {8: tuple(range(8)), 5: (4, 5)}  # dense ones by size of the model
OPTIONS = BackboneOptions(working_px=600, dense_px=300, threads=2)


@dataclass(frozen=True)
class Case:
    survey: Survey
    images: dict[int, WorkingImage]
    backbone: ClassicalBackbone
    seed: LocalModel  # of all eight, nothing known of the camera but its tags
    batch: LocalModel  # 4 and 5 with three references, the camera known

    def enu_from_local(self, model: LocalModel) -> Sim3:
        local = np.array([view.local_from_cam.translation for view in model.views.values()])
        true = np.array([self.survey.views[i].enu_from_cam.translation for i in model.views])
        return weighted_similarity(local, true, np.ones(len(true)))

    def camera_errors(self, model: LocalModel) -> tuple[float, float]:
        """RMS of position (m) and angle (deg) after the similarity that fits the centres."""
        fit = self.enu_from_local(model)
        shift, turn = [], []
        for i, view in model.views.items():
            placed, true = fit.apply_to_pose(view.local_from_cam), self.survey.views[i].enu_from_cam
            shift.append(np.linalg.norm(placed.translation - true.translation))
            turn.append(rotation_angle_deg(placed.rotation.T @ true.rotation))
        return float(np.sqrt(np.mean(np.square(shift)))), float(np.sqrt(np.mean(np.square(turn))))


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Two strips of four photographs, 600 x 450, from 100 m through a distorting lens."""
    survey = plan_survey(
        SurveyOptions(images=8, strips=2, image_width_px=600, image_height_px=450, distorted=True, seed=1)
    )
    shots = oracle_shots(survey)
    images = {i: WorkingImage(shots[i], render(survey.scene, view), PixelMap()) for i, view in enumerate(survey.views)}
    backbone = ClassicalBackbone(OPTIONS, FeatureStore(tmp_path_factory.mktemp("features"), OPTIONS.features))
    seed = backbone.reconstruct(Subset((), tuple(images)), images, {})
    assert isinstance(seed, LocalModel)
    known = {shots[0].camera_key: survey.views[0].camera}
    batch = backbone.reconstruct(Subset((2, 3, 6), (4, 5)), images, known)
    assert isinstance(batch, LocalModel)
    return Case(survey, images, backbone, seed, batch)


def test_cameras_are_where_they_were(case: Case) -> None:
    """A third of a per cent of the flying height with the lens unknown, a tenth with the lens known."""
    altitude_m = case.survey.options.altitude_m
    assert set(case.seed.views) == set(range(8))
    shift_m, turn_deg = case.camera_errors(case.seed)
    assert shift_m < 0.0033 * altitude_m and turn_deg < 0.5
    shift_m, turn_deg = case.camera_errors(case.batch)
    assert shift_m < 0.001 * altitude_m and turn_deg < 0.5


def test_points_project_to_their_own_pixels(case: Case) -> None:
    for model in (case.seed, case.batch):
        for index, view in model.views.items():
            known = view.confidence > 0.0
            pixels = view.camera.project(view.local_from_cam.inverse().apply(view.points[known].astype(float)))
            error = np.abs(pixels - view.camera.pixel_centres()[known])
            # Stereo points lie on the pixel's ray; a sparse point on that of its keypoint, half a pixel and half off.
            assert error.max() <= 1.001
            assert np.median(error) < 0.01 or index not in NEW[len(model.views)]


def test_confidence_lies_in_0_to_1_and_errors_fall_as_it_rises(case: Case) -> None:
    fit = case.enu_from_local(case.batch)
    confidences, errors = [], []
    for i in NEW[5]:
        view = case.batch.views[i]
        assert view.confidence.min() >= 0.0 and view.confidence.max() <= 1.0
        assert (np.isfinite(view.points).all(axis=-1) | (view.confidence == 0.0)).all()
        true = case.survey.views[i]
        grid = true.camera.resized(view.camera.width, view.camera.height)
        depth = case.survey.scene.view(grid, true.enu_from_cam, grid.pixel_centres()).distances
        known = view.confidence.ravel() > 0.0
        own = view.local_from_cam.inverse().apply(view.points.reshape(-1, 3)[known].astype(float))[:, 2] * fit.scale
        confidences.append(view.confidence.ravel()[known])
        errors.append(np.abs(np.log(own / depth.ravel()[known])))
    confidence, error = np.concatenate(confidences), np.concatenate(errors)
    limits = np.quantile(confidence, [0.0, 0.2, 0.5, 0.8, 1.0])
    bins = [error[(confidence >= a) & (confidence <= b)] for a, b in pairwise(limits)]
    ninth = [float(np.quantile(part, 0.9)) for part in bins]
    assert ninth == sorted(ninth, reverse=True)
    assert ninth[0] > 2.0 * ninth[-1]


def test_only_new_images_are_dense(case: Case) -> None:
    known = {i: float((view.confidence > 0.0).mean()) for i, view in case.batch.views.items()}
    assert min(known[4], known[5]) > 0.6
    assert max(known[2], known[3], known[6]) < 0.05


def test_an_unknown_camera_is_calibrated_and_a_known_one_kept(case: Case) -> None:
    key, true = next(iter(case.seed.calibrations)), case.survey.views[0].camera
    assert not case.batch.calibrations
    assert case.batch.views[4].camera.fx == pytest.approx(0.5 * true.fx)
    assert abs(np.log(case.seed.calibrations[key].fx / true.fx)) < 0.02


def test_observations_name_what_was_seen(case: Case) -> None:
    found = case.seed.observations
    assert found is not None
    for i, view in case.seed.views.items():
        rows = found.image == i
        features = case.backbone.features_of(i, case.images[i])
        assert np.allclose(features.pixels[found.feature[rows]], found.pixel[rows])
        camera = case.seed.calibrations[case.images[i].shot.camera_key]
        projected = camera.project(view.local_from_cam.inverse().apply(found.points[found.point[rows]].astype(float)))
        assert np.median(np.linalg.norm(projected - found.pixel[rows], axis=1)) < 1.0


class Stopped(Exception):
    pass


@pytest.mark.parametrize("after", [5, 30, 40])
def test_work_ends_at_a_checkpoint_that_raises(case: Case, after: int) -> None:
    """28 pairs, then about as many steps as there are images, then the images' depth."""
    backbone = ClassicalBackbone(OPTIONS, case.backbone._features)
    calls = []

    def checkpoint() -> None:
        calls.append(1)
        if len(calls) > after:
            raise Stopped

    backbone.interrupt_with(checkpoint)
    with pytest.raises(Stopped):
        backbone.reconstruct(Subset((), tuple(range(8))), case.images, {})
    assert len(calls) == after + 1


def test_subset_without_overlap_is_rejected_with_numbers(case: Case, tmp_path: Path) -> None:
    blank = {i: WorkingImage(case.images[i].shot, np.full((450, 600, 3), 90, np.uint8), PixelMap()) for i in range(3)}
    rejection = ClassicalBackbone(OPTIONS, FeatureStore(tmp_path, 500)).reconstruct(Subset((), (0, 1, 2)), blank, {})
    assert isinstance(rejection, Rejection)
    assert rejection.images == (0, 1, 2) and rejection.numbers == {"images": 3.0, "verified_pairs": 0.0}


def test_a_pair_is_matched_once(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    once = matching.verified_matches

    def counted(*pair: object) -> object:
        asked.append(pair)
        return once(*pair)

    monkeypatch.setattr(matching, "verified_matches", counted)
    matcher = PairMatcher(1)
    features = {i: case.backbone.features_of(i, case.images[i]) for i in range(4)}
    cameras: dict[int, Camera] = dict.fromkeys(features, case.survey.views[0].camera)
    calibrated = dict.fromkeys(features, True)
    first = matcher.match(features, cameras, calibrated, (0, 1, 2))
    again = matcher.match(features, cameras, calibrated, (3, 2, 1))
    assert len(asked) == 5
    assert set(first) == {(0, 1), (0, 2), (1, 2)} and again[1, 2] is first[1, 2]


def test_effort_finds_more_and_keeps_the_numbers_of_features(case: Case) -> None:
    """Images about which little is known may be asked for again: other subsets still know their features by number."""
    known = {case.images[0].shot.camera_key: case.survey.views[0].camera}
    harder = case.backbone.reconstruct(Subset((2, 3, 6), (4, 5), effort=1), case.images, known)
    assert isinstance(harder, LocalModel) and set(harder.views) == set(case.batch.views)
    assert harder.observations is not None and case.batch.observations is not None
    assert len(harder.observations.points) > 1.1 * len(case.batch.observations.points)  # the images hold no more
    for i in harder.views:
        rows = harder.observations.image == i
        number, pixel = harder.observations.feature[rows], harder.observations.pixel[rows]
        usual = case.backbone.features_of(i, case.images[i]).pixels
        shared = number < len(usual)
        assert shared.sum() > 50
        assert np.allclose(usual[number[shared]], pixel[shared])
