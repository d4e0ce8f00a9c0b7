from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from onthefly3r.geometry.transforms import Rigid3, Sim3, nearest_rotation, rotation_angle_deg
from onthefly3r.geometry.umeyama import weighted_similarity
from onthefly3r.records import LocalModel, LocalView, Subset
from onthefly3r.simulate import Survey, bends, oracle
from onthefly3r.simulate.oracle import (
    Faults,
    Noise,
    OracleBackbone,
    OracleDescriber,
    footprint_centre,
    oracle_images,
    scenario,
)

SILENT = Noise(0.0, 0.0, 0.0, 0.0)
SUBSET = Subset((0, 1, 2, 16, 17), (3, 4, 18, 19, 20))


@pytest.fixture(scope="module")
def survey() -> Survey:
    return scenario(30, 2)


def ask(backbone: OracleBackbone, subset: Subset = SUBSET) -> LocalModel:
    model = backbone.reconstruct(subset, {}, {})
    assert isinstance(model, LocalModel)
    return model


def similarity(source: np.ndarray, target: np.ndarray) -> Sim3:
    return weighted_similarity(source, target, np.ones(len(source)))


def true_pose(survey: Survey, index: int) -> Rigid3:
    return survey.views[index].enu_from_cam


def reprojection_px(view: LocalView) -> float:
    points = view.local_from_cam.inverse().apply(view.points.astype(float))
    return float(np.nanmax(np.abs(view.camera.project(points) - view.camera.pixel_centres())))


def pose_errors(survey: Survey, model: LocalModel) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (V,) deg and position (V,) m of a local model's cameras against the truth after a best fit."""
    indices = list(model.views)
    local = np.stack([model.views[i].local_from_cam.translation for i in indices])
    true = np.stack([true_pose(survey, i).translation for i in indices])
    enu_from_local = similarity(local, true)
    turns = [model.views[i].local_from_cam.rotation @ true_pose(survey, i).rotation.T for i in indices]
    mean = nearest_rotation(np.mean(turns, axis=0))
    rotation = np.array([rotation_angle_deg(mean.T @ turn) for turn in turns])
    return rotation, np.linalg.norm(enu_from_local.apply(local) - true, axis=1)


def test_without_noise_the_answer_is_the_truth_in_another_frame(survey: Survey) -> None:
    model = ask(OracleBackbone(survey, SILENT))
    assert list(model.views) == list(SUBSET.members)
    rotation, position = pose_errors(survey, model)
    assert rotation.max() < 1e-5 and position.max() < 1e-9
    local = np.stack([view.local_from_cam.translation for view in model.views.values()])
    true = np.stack([true_pose(survey, i).translation for i in model.views])
    enu_from_local = similarity(local, true)
    assert abs(enu_from_local.scale - 1.0) > 10.0  # not metres by accident
    for view in model.views.values():
        assert reprojection_px(view) < 1e-3
        points = enu_from_local.apply(view.points[::20, ::20].reshape(-1, 3).astype(float))
        assert survey.scene.distance_to_surface(points).max() < 1e-3


@pytest.mark.parametrize("faults", [Faults(), Faults(doming_m=3.0), Faults(bad_references=2, bad_reference_rate=1.0)])
def test_points_fit_the_camera_they_come_with(survey: Survey, faults: Faults) -> None:
    for view in ask(OracleBackbone(survey, faults=faults)).views.values():
        assert view.points.shape == (168, 224, 3) and view.points.dtype == np.float32
        assert (view.camera.width, view.camera.height) == (224, 168)
        assert reprojection_px(view) < 1e-2
        photo = view.grid_from_photo.apply(np.array([1000.0, 750.0]))
        np.testing.assert_allclose(photo, [224.0, 168.0])


def test_pose_and_scale_noise_have_the_stated_size(survey: Survey) -> None:
    backbone = OracleBackbone(survey)
    subset = Subset((), (0, 4, 8, 12, 15, 19, 23, 27))
    rotation, position, log_scale = [], [], []
    for _ in range(60):
        model = ask(backbone, subset)
        errors = pose_errors(survey, model)
        rotation.append(errors[0])
        position.append(errors[1])
        local = np.stack([view.local_from_cam.translation for view in model.views.values()])
        true = np.stack([true_pose(survey, i).translation for i in model.views])
        log_scale.append(np.log(similarity(local, true).scale))
    # The fit takes 3 of 24 degrees of freedom of the rotations and 7 of 24 of the positions.
    assert np.sqrt(np.mean(np.square(rotation)) * 24 / 21) == pytest.approx(0.15, rel=0.08)
    assert np.sqrt(np.mean(np.square(position)) * 24 / 17) == pytest.approx(0.30, rel=0.08)
    # 60 draws know a standard deviation to 9 %.
    assert np.std(log_scale) == pytest.approx(0.10, rel=0.27)
    assert np.mean(log_scale) == pytest.approx(np.log(100.0), abs=0.06)


def test_noise_grows_with_the_flying_height() -> None:
    high = oracle.plan_survey(oracle.SurveyOptions(images=24, strips=3, altitude_m=300.0))
    backbone = OracleBackbone(high)
    position = [pose_errors(high, ask(backbone, Subset((), tuple(range(0, 24, 3)))))[1] for _ in range(10)]
    assert np.sqrt(np.mean(np.square(position)) * 24 / 17) == pytest.approx(0.90, rel=0.2)


def test_depth_noise_is_per_pixel_and_per_image(survey: Survey) -> None:
    backbone = OracleBackbone(survey)
    within, means = [], []
    for _ in range(6):
        model = ask(backbone)
        ratios = []
        for index, view in model.views.items():
            depth = view.local_from_cam.inverse().apply(view.points.astype(float))[..., 2]
            ratio = np.log(depth / backbone.true_depth(index))
            within.append(np.std(ratio))
            ratios.append(np.mean(ratio))
        means.append(np.std(ratios, ddof=1))  # the subset's scale is common to its images
    assert np.mean(within) == pytest.approx(0.002, rel=0.02)
    assert np.sqrt(np.mean(np.square(means))) == pytest.approx(0.002, rel=0.3)


def test_confidence_falls_with_the_error(survey: Survey) -> None:
    backbone = OracleBackbone(survey)
    view = ask(backbone).views[3]
    depth = view.local_from_cam.inverse().apply(view.points.astype(float))[..., 2]
    ratio = depth / backbone.true_depth(3)
    error = np.abs(ratio / np.median(ratio) - 1.0)
    quarters = np.array_split(np.argsort(view.confidence.ravel()), 4)
    means = [error.ravel()[quarter].mean() for quarter in quarters]
    assert means[0] > 1.5 * means[1] and means[1] > 1.5 * means[2] and means[2] > 1.2 * means[3]
    assert view.confidence.min() >= 0.0 and view.confidence.max() <= 1.0
    assert 0.8 < (view.confidence >= backbone.spec.confidence_threshold).mean() < 0.95


def test_bad_references_occur_at_the_stated_rate_and_are_far_off(survey: Survey) -> None:
    backbone = OracleBackbone(survey, SILENT, Faults(bad_references=1, bad_reference_rate=0.5))
    subset = Subset((0, 1, 2, 3), (4,))
    bad_calls = 0
    for _ in range(120):
        model = ask(backbone, subset)
        query = model.views[4].local_from_cam.rotation @ true_pose(survey, 4).rotation.T
        angles = [
            rotation_angle_deg(query.T @ model.views[i].local_from_cam.rotation @ true_pose(survey, i).rotation.T)
            for i in subset.references
        ]
        off = sum(angle > 1.0 for angle in angles)
        assert off in (0, 1) and model.notes["bad_views"] == off
        if off:
            assert max(angles) == pytest.approx(30.0, abs=1e-3)
        bad_calls += off
    assert 0.5 - 0.14 < bad_calls / 120 < 0.5 + 0.14  # three sigmas of 120 draws


def test_bad_queries_spare_the_seed_unless_asked(survey: Survey) -> None:
    seed_subset, later = Subset((), (0, 1, 2)), Subset((0, 1), (2, 3))
    sparing = OracleBackbone(survey, faults=Faults(bad_query_rate=1.0))
    assert ask(sparing, seed_subset).notes["bad_views"] == 0.0
    assert ask(sparing, later).notes["bad_views"] == 1.0
    assert ask(OracleBackbone(survey, faults=Faults(bad_query_rate=1.0, in_seed=True)), seed_subset).notes["bad_views"]
    two = OracleBackbone(survey, faults=Faults(bad_references=2, bad_reference_rate=1.0))
    assert ask(two, later).notes["bad_views"] == 2.0
    assert ask(two, seed_subset).notes["bad_views"] == 0.0


def test_doming_bends_cameras_and_points_alike(survey: Survey) -> None:
    bent = ask(OracleBackbone(survey, SILENT, Faults(doming_m=3.0)), Subset((), (0, 4, 8, 12, 15, 19, 23, 27)))
    middle = np.mean([true_pose(survey, i).translation for i in bent.views], axis=0)
    bowl = bends.Bend(middle, 3.0 * bends.BEND_FORMS["bowl"], survey.options.altitude_m)
    truth = {i: true_pose(survey, i) for i in bent.views}
    lifted = np.stack([bowl.apply(pose.translation) for pose in truth.values()])
    local = np.stack([view.local_from_cam.translation for view in bent.views.values()])
    bent_from_local = similarity(local, lifted)
    np.testing.assert_allclose(bent_from_local.apply(local), lifted, atol=1e-9)
    assert np.ptp(lifted[:, 2] - np.stack([p.translation for p in truth.values()])[:, 2]) > 1.0
    for index, view in bent.views.items():
        points = bent_from_local.apply(view.points.astype(float))[::8, ::8]
        true_points = truth[index].apply(
            OracleBackbone(survey).true_depth(index)[..., None] * view.camera.rays(view.camera.pixel_centres())
        )[::8, ::8]
        # Calibrated rays cannot bend: towards the image corners the surface is met up to 1.6 m beside.
        error = np.abs(points - bowl.apply(true_points))
        assert error[..., 2].max() < 0.25 and error.max() < 2.0


@pytest.mark.parametrize("form", ["bowl", "saddle", "cylinder"])
def test_a_model_is_bent_in_the_form_asked_for(survey: Survey, form: bends.BendForm) -> None:
    """However much was drawn: a bend of that form explains all, one of another form does not."""
    bent = ask(OracleBackbone(survey, replace(SILENT, bend_m=3.0, bend_form=form)), Subset((), tuple(range(0, 28, 3))))
    truth = np.stack([true_pose(survey, i).translation for i in bent.views])
    local = np.stack([view.local_from_cam.translation for view in bent.views.values()])

    def misfit(sag_m: float, of_form: bends.BendForm) -> float:
        bend = bends.Bend(truth.mean(axis=0), sag_m * bends.BEND_FORMS[of_form], survey.options.altitude_m)
        lifted = bend.apply(truth)
        return float(np.abs(similarity(local, lifted).apply(local) - lifted).max())

    least = {f: minimize_scalar(misfit, (0.0, 1.0), args=(f,)).fun for f in bends.BEND_FORMS}
    assert least[form] < 1e-5
    assert all(value > 0.01 for f, value in least.items() if f != form)


def test_tokens_turn_away_for_bad_views(survey: Survey) -> None:
    backbone = OracleBackbone(survey, faults=Faults(bad_references=1, bad_reference_rate=1.0), tokens=True)
    assert backbone.spec.has_tokens
    model = ask(backbone)
    tokens = np.stack([view.tokens for view in model.views.values() if view.tokens is not None])
    mean_cosine = (tokens @ tokens.T - np.eye(10)).sum(axis=1) / 9
    assert (np.sort(mean_cosine)[1:] > 0.8).all() and mean_cosine.min() < 0.75
    assert ask(OracleBackbone(survey)).views[0].tokens is None


def test_answers_are_drawn_from_seed_and_call_number(survey: Survey) -> None:
    first, second = OracleBackbone(survey, seed=5), OracleBackbone(survey, seed=5)
    one, again = ask(first), ask(second)
    np.testing.assert_array_equal(one.views[4].points, again.views[4].points)
    assert not np.array_equal(one.views[4].points, ask(first).views[4].points)
    assert not np.array_equal(one.views[4].points, ask(OracleBackbone(survey, seed=6)).views[4].points)


def test_new_cameras_are_calibrated_once(survey: Survey) -> None:
    backbone = OracleBackbone(survey)
    calibrations = ask(backbone).calibrations
    assert list(calibrations.values()) == [survey.views[0].camera]
    known = backbone.reconstruct(SUBSET, {}, calibrations)
    assert isinstance(known, LocalModel) and not known.calibrations


def test_depth_cache_is_bounded(survey: Survey, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oracle, "CACHED_DEPTH_MAPS", 4)
    backbone = OracleBackbone(survey)
    first = backbone.true_depth(0).copy()
    for index in range(10):
        backbone.true_depth(index)
    assert list(backbone._depths) == [6, 7, 8, 9]
    np.testing.assert_array_equal(backbone.true_depth(0), first)


def test_similarity_follows_ground_distance(survey: Survey) -> None:
    describer, images = OracleDescriber(survey), oracle_images(survey)
    describer.fit(images)
    vectors = np.stack([describer.describe(i, image) for i, image in images.items()])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-6)
    assert vectors.dtype == np.float32
    places = np.stack([footprint_centre(view) for view in survey.views])
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    cosine = vectors @ vectors.T
    pairs = np.triu_indices(len(places), 1)
    rings = []
    for nearest in range(0, 200, 40):
        ring = (distance[pairs] >= nearest) & (distance[pairs] < nearest + 40)
        rings.append(cosine[pairs][ring].mean())
    assert rings[0] > 0.8 and rings[0] > rings[1] > rings[2] > rings[3] > rings[4] - 0.1
    assert rings[4] < 0.3


def test_look_alike_blocks_confuse_the_describer() -> None:
    plain, confused = (scenario(160, 8, look_alike=flag) for flag in (False, True))
    blocks = confused.scene.blocks + oracle.BLOCK_SIZE_M / 2
    places = np.stack([footprint_centre(view) for view in confused.views])
    nearest = [int(np.argmin(np.linalg.norm(places - block, axis=1))) for block in blocks]
    confusion = []
    for survey in (plain, confused):
        describer, images = OracleDescriber(survey), oracle_images(survey)
        vectors = np.stack([describer.describe(i, images[i]) for i in nearest])
        confusion.append((vectors @ vectors.T)[np.triu_indices(len(nearest), 1)].mean())
    assert confusion[1] > confusion[0] + 0.2


def test_images_stand_in_for_photographs(survey: Survey) -> None:
    images = oracle_images(survey)
    view = ask(OracleBackbone(survey)).views[3]
    image = images[3]
    assert image.rgb.shape == view.points.shape and image.rgb.dtype == np.uint8
    assert image.working_from_photo == view.grid_from_photo
    assert image.prior_camera.fx == pytest.approx(view.camera.fx)
    assert image.shot.gps == survey.views[3].gps and image.shot.name == survey.views[3].name


def test_a_survey_of_thousands_of_images_is_planned_without_casting_rays() -> None:
    large = scenario(3000, 50)
    model = ask(OracleBackbone(large), Subset((1500, 1501, 1502), (1503, 1504)))
    assert all(np.isfinite(view.points).mean() > 0.99 for view in model.views.values())
