from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pycolmap
import pyproj
import pytest
from PIL import ExifTags, Image

from onthefly3r.errors import Cancelled
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.geometry.geodesy import EnuFrame, WorldFrame
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.intake.metadata import read_shot
from onthefly3r.options import IntakeOptions
from onthefly3r.protocol import Progress
from onthefly3r.records import Attitude, GpsFix
from onthefly3r.simulate import Survey, SurveyOptions, TrueView, plan_survey, simulate_survey
from onthefly3r.simulate.landscape import Hills, building, ground_patch
from onthefly3r.simulate.photographs import render, write_photograph
from onthefly3r.simulate.scene import assemble_scene

SMALL = SurveyOptions(images=6, strips=2, image_width_px=320, image_height_px=240, gps_sigma_h_m=0.5, distorted=True)


@pytest.fixture(scope="module")
def small_survey(tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, Path, list[Progress]]:
    out = tmp_path_factory.mktemp("survey")
    reports: list[Progress] = []
    return simulate_survey(out, SMALL, reports.append), out, reports


def test_landmark_appears_at_its_projection_in_its_colour() -> None:
    flat, bounds = Hills.draw(0.0, np.random.default_rng(0)), (-60.0, -60.0, 60.0, 60.0)
    # A flat red roof (look 0): seen from straight above its outline is centred on the projection of its middle.
    house = building(np.array([8.0, -5.0]), np.array([12.0, 9.0, 4.0]), 0.4, floor_m=0.0, gable_m=0.0, look=0)
    scene = assemble_scene([ground_patch(flat, bounds, 2.0), *house], flat, bounds, seed=0)
    camera = Camera(400, 300, 272.0, 272.0, 203.0, 148.0)
    pose = Rigid3(enu_from_cam_rotation(30.0, -90.0, 0.0), np.array([0.0, 0.0, 50.0]))
    fix, attitude = GpsFix(48.0, 15.0, 350.0, "ellipsoidal"), Attitude(30.0, -90.0, 0.0)
    image = render(scene, TrueView("red.jpg", camera, pose, fix, attitude, 0.0, 0), supersampling=3.0).astype(float)
    red = (image[..., 0] > 1.4 * image[..., 1]).astype(np.uint8)
    outlines, _ = cv2.findContours(red, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    middle, size, _ = cv2.minAreaRect(max(outlines, key=cv2.contourArea))
    expected = camera.project(pose.inverse().apply(np.array([8.0, -5.0, 4.0])))
    np.testing.assert_allclose(np.array(middle) + 0.5, expected, atol=0.25)
    # The outermost red pixels' centres lie half a pixel inside the roof.
    np.testing.assert_allclose(sorted(np.array(size) + 1.0), np.array([9.0, 12.0]) * 272.0 / 46.0, atol=1.5)


def test_neighbouring_photographs_match_where_the_truth_says() -> None:
    survey = plan_survey(SurveyOptions(image_width_px=640, image_height_px=480))
    first, second = survey.views[4], survey.views[5]
    sift = cv2.SIFT_create(2000)
    (key_a, code_a), (key_b, code_b) = (
        sift.detectAndCompute(cv2.cvtColor(render(survey.scene, view), cv2.COLOR_RGB2GRAY), None)
        for view in (first, second)
    )
    pairs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(code_a, code_b)
    pixels_a = np.array([key_a[m.queryIdx].pt for m in pairs]) + 0.5
    pixels_b = np.array([key_b[m.trainIdx].pt for m in pairs]) + 0.5
    hits = survey.scene.view(first.camera, first.enu_from_cam, pixels_a)
    expected = second.camera.project(second.enu_from_cam.inverse().apply(hits.points))
    error = np.linalg.norm(expected - pixels_b, axis=1)
    good = error < 1.0
    assert good.sum() > 300
    # OpenCV's own keypoint offsets aside, the photographs agree with the truth to a tenth of a pixel.
    assert np.abs(np.median((expected - pixels_b)[good], axis=0)).max() < 0.15
    assert np.median(error[good]) < 0.5


def test_photograph_is_drawn_from_its_survey() -> None:
    survey = plan_survey(SMALL)
    np.testing.assert_array_equal(render(survey.scene, survey.views[1]), render(survey.scene, survey.views[1]))


def test_tags_are_read_back_by_pillow(small_survey: tuple[Survey, Path, list[Progress]]) -> None:
    survey, out, _ = small_survey
    view = survey.views[2]
    with Image.open(out / "photos" / view.name) as image:
        exif, xmp = image.getexif(), image.info["xmp"].decode()
        details, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
        assert image.size == (320, 240) and image.mode == "RGB"
    assert (exif[ExifTags.Base.Make], exif[ExifTags.Base.Model]) == ("OnTheFly3R", "Simulator")
    assert details[ExifTags.Base.DateTimeOriginal] == "2024:06:01 10:00:04"
    assert details[ExifTags.Base.FocalLengthIn35mmFilm] == 24
    assert float(details[ExifTags.Base.FocalLength]) == pytest.approx(8.8)
    degrees, minutes, seconds = (float(part) for part in gps[ExifTags.GPS.GPSLatitude])
    assert gps[ExifTags.GPS.GPSLatitudeRef] == "N"
    # 1e-7 degrees are a centimetre.
    assert degrees + minutes / 60 + seconds / 3600 == pytest.approx(view.gps.lat_deg, abs=1e-8)
    assert f'drone-dji:AbsoluteAltitude="{view.gps.height_m:+.3f}"' in xmp
    assert f'drone-dji:GimbalPitchDegree="{view.attitude.pitch_deg:+.2f}"' in xmp
    assert 'drone-dji:RtkFlag="50"' in xmp and 'drone-dji:RtkStdHgt="0.05000"' in xmp


@pytest.mark.parametrize("rtk", [True, False])
def test_intake_reads_what_the_survey_says(tmp_path: Path, rtk: bool) -> None:
    survey = plan_survey(SurveyOptions(images=4, strips=2, rtk=rtk), EnuFrame(-33.9, -70.6, 520.0))
    view = survey.views[1]
    path = tmp_path / view.name
    write_photograph(path, np.zeros((750, 1000, 3), np.uint8), view)
    shot = read_shot(path, view.name, IntakeOptions())
    assert shot.gps is not None and view.gps.height_m is not None and shot.attitude is not None
    assert (shot.gps.lat_deg, shot.gps.lon_deg) == pytest.approx((view.gps.lat_deg, view.gps.lon_deg), abs=1e-8)
    assert shot.gps.height_m == pytest.approx(view.gps.height_m, abs=1e-3)
    assert shot.gps.vertical == view.gps.vertical == ("ellipsoidal" if rtk else "egm96")
    assert (shot.gps.sigma_h_m, shot.gps.sigma_v_m, shot.gps.rtk) == ((0.03, 0.05, 50) if rtk else (None, None, None))
    assert shot.attitude.yaw_deg == pytest.approx(view.attitude.yaw_deg, abs=0.01)
    assert shot.focal_ratio == pytest.approx(view.camera.fx / view.camera.width, rel=0.05)
    assert shot.time_s == view.time_s
    assert shot.warnings == ()


def test_survey_leaves_complete_files_and_reports_progress(small_survey: tuple[Survey, Path, list[Progress]]) -> None:
    survey, out, reports = small_survey
    names = sorted(path.name for path in (out / "photos").iterdir())
    assert names == [view.name for view in survey.views]
    model = {f"{name}{suffix}" for name in ("cameras", "images", "points3D") for suffix in (".txt", ".bin")}
    assert {path.name for path in (out / "truth").iterdir()} == {*model, "cloud.las", "origin.json"}
    assert [report.done for report in reports] == list(range(7))
    assert {(report.stage, report.total) for report in reports} == {("simulate", 6)}


def test_cancelling_ends_the_rendering(tmp_path: Path) -> None:
    def cancel(progress: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        simulate_survey(tmp_path, replace(SMALL, images=40), cancel)
    assert len(list((tmp_path / "photos").glob("*"))) < 20


def test_true_cameras_open_in_colmap(small_survey: tuple[Survey, Path, list[Progress]]) -> None:
    survey, out, _ = small_survey
    model = pycolmap.Reconstruction(out / "truth")
    assert model.num_images() == 6 and model.num_points3D() > 500
    for image in model.images.values():
        view = next(v for v in survey.views if v.name == image.name)
        np.testing.assert_allclose(image.projection_center(), view.enu_from_cam.translation, atol=1e-9)
        np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), view.enu_from_cam.rotation.T, atol=1e-12)
        errors = [
            np.linalg.norm(image.project_point(model.points3D[p.point3D_id].xyz) - p.xy)
            for p in image.points2D
            if p.has_point3D()
        ]
        assert len(errors) > 100 and max(errors) < 1e-6


@pytest.mark.parametrize("rtk", [True, False])
def test_true_cloud_lies_on_the_surface_in_the_named_crs(
    small_survey: tuple[Survey, Path, list[Progress]], tmp_path: Path, rtk: bool
) -> None:
    survey, out, _ = small_survey
    if not rtk:
        out = tmp_path
        survey = simulate_survey(out, replace(SMALL, rtk=False))
    place = json.loads((out / "truth" / "origin.json").read_text())
    cloud = laspy.read(out / "truth" / "cloud.las")
    crs = pyproj.CRS.from_wkt(next(v.string for v in cloud.header.vlrs if v.record_id == 2112))
    # PROJ reads a projected CRS with ellipsoidal heights back as one CRS of three axes.
    assert crs.name.startswith("WGS 84 / UTM zone 33N") and place["crs"] == "EPSG:32633"
    assert len(crs.axis_info) == 3
    assert crs.is_compound == (not rtk) and ("EGM96" in crs.name) == (not rtk)
    origin = EnuFrame(place["lat_deg"], place["lon_deg"], place["height_m"])
    enu = WorldFrame(place["crs"], place["vertical"], origin).to_enu(np.asarray(cloud.xyz)[::50])
    assert len(enu) > 500
    assert survey.scene.distance_to_surface(enu).max() < 0.002
    assert np.asarray(cloud.green).std() > 20 * 257
