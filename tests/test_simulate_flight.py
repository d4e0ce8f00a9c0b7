from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from onthefly3r.errors import OptionError
from onthefly3r.geometry.frames import enu_from_cam_rotation, gimbal_angles_deg
from onthefly3r.geometry.geoid import egm96_undulation_m
from onthefly3r.geometry.transforms import rotation_angle_deg
from onthefly3r.simulate import Survey, SurveyOptions, plan_survey


def positions(survey: Survey) -> np.ndarray:
    return np.array([view.enu_from_cam.translation for view in survey.views])


def tagged_positions(survey: Survey) -> np.ndarray:
    fixes = [view.gps for view in survey.views]
    return survey.origin.from_geographic(np.array([[f.lat_deg, f.lon_deg, f.height_m] for f in fixes]))


@pytest.fixture(scope="module")
def demo() -> Survey:
    return plan_survey(SurveyOptions())


def test_demo_survey_has_the_overlaps_it_states(demo: Survey) -> None:
    assert len(demo.views) == 40
    camera, options = demo.views[0].camera, demo.options
    centres = positions(demo).reshape(4, 10, 3)
    assert abs(centres[..., 2].mean() - options.altitude_m) < 0.3
    base_m = np.abs(np.diff(centres[..., 0], axis=1)).mean()
    spacing_m = np.abs(np.diff(centres[..., 1].mean(axis=1))).mean()
    assert 1.0 - base_m / (camera.height / camera.fy * options.altitude_m) == pytest.approx(0.80, abs=0.005)
    assert 1.0 - spacing_m / (camera.width / camera.fx * options.altitude_m) == pytest.approx(0.65, abs=0.005)


def test_strips_are_serpentine_and_the_image_top_points_along_the_flight(demo: Survey) -> None:
    centres = positions(demo).reshape(4, 10, 3)
    east = centres[:, -1, 0] - centres[:, 0, 0]
    assert (np.sign(east) == [1, -1, 1, -1]).all()
    for strip in range(4):
        top = -np.array([view.enu_from_cam.rotation[:, 1] for view in demo.views[10 * strip : 10 * strip + 10]])
        assert (top[:, 0] * np.sign(east[strip]) > 0.99).all()
    times = np.array([view.time_s for view in demo.views])
    assert (np.diff(times) > 0).all()


@pytest.mark.parametrize(("plan", "tilt_deg"), [("strips", 0.0), ("oblique", 15.0), ("cross", 15.0)])
def test_cameras_are_pitched_as_planned(plan: str, tilt_deg: float) -> None:
    survey = plan_survey(SurveyOptions(plan=plan, images=60, strips=3))
    axes = np.array([view.enu_from_cam.rotation[:, 2] for view in survey.views])
    tilt = np.degrees(np.arccos(-axes[:, 2]))
    assert abs(np.median(tilt) - tilt_deg) < 2.0
    headings = {round(view.attitude.yaw_deg / 90.0) % 4 for view in survey.views}
    if plan == "cross":
        assert headings == {0, 1, 2, 3}
        assert {view.flight for view in survey.views} == {0, 1}
    elif plan == "oblique":
        assert headings == {1, 3}


def test_position_noise_has_the_stated_size() -> None:
    options = SurveyOptions(images=2000, strips=20, gps_sigma_h_m=0.5, gps_sigma_v_m=1.5)
    survey = plan_survey(options)
    error = tagged_positions(survey) - positions(survey)
    # 2,000 draws know a standard deviation to 1.6 % and a mean to 2 % of it; five sigmas of both.
    np.testing.assert_allclose(error.std(axis=0), [0.5, 0.5, 1.5], rtol=0.08)
    np.testing.assert_allclose(error.mean(axis=0) / [0.5, 0.5, 1.5], 0.0, atol=0.11)
    assert survey.views[0].gps.sigma_h_m == 0.5 and survey.views[0].gps.rtk == 50


def test_flights_have_height_biases_of_their_own() -> None:
    options = SurveyOptions(plan="cross", images=40, strips=2, height_bias_m=10.0, seed=2)
    survey = plan_survey(options)
    error = (tagged_positions(survey) - positions(survey))[:, 2]
    flight = np.array([view.flight for view in survey.views])
    bias = [error[flight == f].mean() for f in (0, 1)]
    assert abs(bias[0] - bias[1]) > 1.0
    assert max(error[flight == f].std() for f in (0, 1)) < 0.1


def test_tags_of_a_drone_without_rtk_are_above_the_geoid() -> None:
    with_rtk = plan_survey(SurveyOptions(images=4, strips=2))
    without = plan_survey(SurveyOptions(images=4, strips=2, rtk=False))
    fix, plain = with_rtk.views[1].gps, without.views[1].gps
    assert (fix.vertical, plain.vertical) == ("ellipsoidal", "egm96")
    assert plain.sigma_h_m is None and plain.rtk is None
    undulation_m = float(egm96_undulation_m(plain.lat_deg, plain.lon_deg))
    assert fix.height_m is not None and plain.height_m is not None
    assert fix.height_m - plain.height_m == pytest.approx(undulation_m, abs=1e-6)
    assert undulation_m > 40.0


def test_gimbal_angles_are_told_with_noise() -> None:
    survey = plan_survey(SurveyOptions(images=500, strips=10, plan="oblique"))
    angles = []
    for view in survey.views:
        told = enu_from_cam_rotation(view.attitude.yaw_deg, view.attitude.pitch_deg, view.attitude.roll_deg)
        angles.append(rotation_angle_deg(told.T @ view.enu_from_cam.rotation))
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(0.3 * np.sqrt(3.0), rel=0.1)
    pitch = [gimbal_angles_deg(view.enu_from_cam.rotation)[1] for view in survey.views]
    assert np.std(pitch) == pytest.approx(1.2, rel=0.2)


def test_gaps_take_runs_of_images_away() -> None:
    whole, holed = (plan_survey(SurveyOptions(images=60, gaps=gaps, seed=5)) for gaps in (0, 2))
    assert 54 <= len(holed.views) <= 57
    pause = np.diff([view.time_s for view in holed.views])
    assert sorted(pause)[-2] >= 8.0 and max(np.diff([view.time_s for view in whole.views])) == 14.0
    assert [view.name for view in holed.views] == [f"SIM_{i + 1:04d}.JPG" for i in range(len(holed.views))]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"images": 5, "strips": 6}, "too few"),
        ({"images": 4, "strips": 1, "gaps": 1}, "fewer than 3"),
        ({"altitude_m": 2.0}, "altitude_m"),
        ({"plan": "spiral"}, "plan"),
    ],
)
def test_impossible_plans_say_why(values: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        plan_survey(dataclasses.replace(SurveyOptions(), **values))  # type: ignore[arg-type]


def test_survey_is_drawn_from_its_seed(demo: Survey) -> None:
    again, other = plan_survey(SurveyOptions()), plan_survey(SurveyOptions(seed=1))
    np.testing.assert_array_equal(positions(again), positions(demo))
    assert [v.gps for v in again.views] == [v.gps for v in demo.views]
    assert not np.array_equal(positions(other), positions(demo))
