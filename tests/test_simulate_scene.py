from __future__ import annotations

import numpy as np
import pytest

from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.simulate.landscape import GROUND, ROOF, WALL, Hills, building, ground_patch
from onthefly3r.simulate.scene import Scene, assemble_scene, make_scene

BOUNDS = (-60.0, -50.0, 60.0, 50.0)
FLAT = Hills.draw(0.0, np.random.default_rng(0))


def flat_scene_with_box() -> Scene:
    """Flat ground and a box 20 m by 10 m by 6 m high about the origin, along the axes."""
    box = building(np.zeros(2), np.array([20.0, 10.0, 6.0]), yaw=0.0, floor_m=0.0, gable_m=0.0, look=0)
    return assemble_scene([ground_patch(FLAT, BOUNDS, 2.0), *box], FLAT, BOUNDS, seed=0)


@pytest.fixture(scope="module")
def hilly() -> Scene:
    return make_scene(BOUNDS, seed=3)


def test_rays_meet_plane_and_box_where_geometry_says() -> None:
    scene = flat_scene_with_box()
    origin = np.array([1.0, -40.0, 30.0])
    targets = np.array([[31.3, -12.1, 0.0], [3.2, 1.7, 6.0], [-4.4, -5.0, 2.5], [1.0, -40.0, 0.0]])
    hits = scene.cast(origin, targets - origin)
    np.testing.assert_allclose(hits.points, targets, atol=1e-9)
    np.testing.assert_allclose(hits.distances, 1.0, atol=1e-10)
    np.testing.assert_allclose(hits.normals, [[0, 0, 1], [0, 0, 1], [0, -1, 0], [0, 0, 1]], atol=1e-12)
    assert scene.material[hits.faces].tolist() == [GROUND, ROOF, WALL, GROUND]


def test_rays_into_the_sky_miss() -> None:
    hits = flat_scene_with_box().cast(np.array([[0.0, 0, 30], [500.0, 0, 30]]), np.array([[0.3, 0, 1.0], [0, 0, -1.0]]))
    assert hits.faces.tolist() == [-1, -1]
    assert np.isnan(hits.distances).all() and np.isnan(hits.points).all()


def test_rays_along_a_wall_stay_finite() -> None:
    scene = flat_scene_with_box()
    hits = scene.cast(np.array([[10.0, 0.0, 50.0], [10.0 + 1e-7, 2.0, 50.0]]), np.array([[0.0, 0.0, -1.0]] * 2))
    assert np.isin(np.round(hits.points[:, 2], 3), (0.0, 6.0)).all()


def test_camera_view_gives_depth_along_the_optical_axis() -> None:
    scene = flat_scene_with_box()
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0, (-0.05, 0.01, 1e-3, -1e-3))
    pose = Rigid3(enu_from_cam_rotation(40.0, -90.0, 0.0), np.array([0.0, 0.0, 40.0]))
    hits = scene.view(camera, pose, camera.pixel_centres())
    np.testing.assert_allclose(hits.distances, np.where(scene.material[hits.faces] == ROOF, 34.0, hits.distances))
    on_ground = scene.material[hits.faces] == GROUND
    np.testing.assert_allclose(hits.distances[on_ground], 40.0, atol=1e-9)
    pixels = camera.project(pose.inverse().apply(hits.points)).reshape(40, 60, 2)
    np.testing.assert_allclose(pixels, camera.pixel_centres(), atol=1e-6)


def test_mesh_follows_the_hills(hilly: Scene) -> None:
    rng = np.random.default_rng(0)
    start = np.column_stack([rng.uniform(-55, 55, 2000), rng.uniform(-45, 45, 2000), np.full(2000, 50.0)])
    hits = hilly.cast(start, np.tile([0.0, 0.0, -1.0], (2000, 1)))
    ground = hilly.material[hits.faces] == GROUND
    assert 0.5 < ground.mean() < 1.0
    height = hilly.hills.height(hits.points[ground, 0], hits.points[ground, 1])
    # The sagitta of 2 m cells on waves of 70 m length is below 1 cm.
    assert np.abs(height - hits.points[ground, 2]).max() < 0.02
    assert np.ptp(height) > 1.0


def test_distance_to_surface_is_measured_to_triangles() -> None:
    scene = flat_scene_with_box()
    points = np.array([[30.0, 30, 0.4], [30.3, 30.9, -0.25], [2.0, 1.0, 6.3], [11.5, 2.0, 3.0], [13.0, 0.0, 10.0]])
    expected = [0.4, 0.25, 0.3, 1.5, 5.0]  # the last one to the edge of the roof: 3 m out, 4 m up
    np.testing.assert_allclose(scene.distance_to_surface(points), expected, atol=1e-9)


def test_surface_samples_lie_on_the_surface_and_see_the_sky(hilly: Scene) -> None:
    hits = hilly.sample_surface(5000, seed=1)
    assert len(hits.points) > 3500
    assert hilly.distance_to_surface(hits.points).max() < 1e-6
    above = hilly.cast(hits.points + np.array([0.0, 0.0, 200.0]), np.tile([0.0, 0.0, -1.0], (len(hits.points), 1)))
    level = np.abs(hits.normals[:, 2]) > 0.5
    np.testing.assert_allclose(above.points[level, 2], hits.points[level, 2], atol=0.05)
    np.testing.assert_array_equal(hilly.sample_surface(5000, seed=1).points, hits.points)


def test_colour_belongs_to_the_place_not_to_the_ray(hilly: Scene) -> None:
    samples = hilly.sample_surface(3000, seed=2)
    colours = []
    for eye in ([0.0, 0.0, 90.0], [15.0, -10.0, 70.0]):
        hits = hilly.cast(np.array(eye), samples.points - eye)
        same = np.abs(hits.distances - 1.0) < 1e-6
        colours.append((same, hilly.colour(hits)))
    both = colours[0][0] & colours[1][0]
    assert both.mean() > 0.5
    difference = np.abs(colours[0][1][both].astype(int) - colours[1][1][both])
    assert np.percentile(difference, 99) <= 1
    assert colours[0][1][both].std(axis=0).min() > 15.0  # and it varies


def test_details_below_the_footprint_are_left_out(hilly: Scene) -> None:
    hits = hilly.cast(np.array([0.0, 0, 80]), np.column_stack([np.linspace(-0.2, 0.2, 4000)] * 2 + [-np.ones(4000)]))
    fine, coarse = (hilly.colour(hits, footprint).astype(float) for footprint in (0.0, 2.0))
    roughness = [np.abs(np.diff(c[:, 1])).mean() for c in (fine, coarse)]
    assert roughness[1] < 0.5 * roughness[0]


def test_look_alike_blocks_repeat_houses_and_ground() -> None:
    scene = make_scene((-200.0, -200.0, 200.0, 200.0), seed=1, look_alike=True, hill_height_m=0.0)
    assert len(scene.blocks) >= 4
    rng = np.random.default_rng(0)
    within = rng.uniform(1.0, 59.0, (3000, 2))
    colours, heights = [], []
    for corner in scene.blocks[:2]:
        start = np.column_stack([corner + within, np.full(3000, 60.0)])
        hits = scene.cast(start, np.tile([0.0, 0.0, -1.0], (3000, 1)))
        colours.append(scene.colour(hits).astype(int))
        heights.append(hits.points[:, 2])
    np.testing.assert_allclose(heights[0], heights[1], atol=1e-6)
    assert np.ptp(heights[0]) > 5.0
    assert np.percentile(np.abs(colours[0] - colours[1]), 99) <= 3


def test_scene_is_drawn_from_its_seed(hilly: Scene) -> None:
    np.testing.assert_array_equal(make_scene(BOUNDS, seed=3).triangles, hilly.triangles)
    assert not np.array_equal(make_scene(BOUNDS, seed=4).triangles[:1000], hilly.triangles[:1000])
