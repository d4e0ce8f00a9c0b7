"""Incremental structure from motion of one subset with pycolmap, all in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ..adjust.sparse_model import SparseModel, Track
from ..features.pycolmap_module import load_pycolmap, to_pycolmap_camera
from ..geometry.arrays import Int
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from ..records import Features

MIN_MODEL_SIZE = 3
MIN_FIRST_MATCHES = 30  # of a pair that a model is begun with when the usual demands found too little
MORE_STARTS = 3  # pairs that are tried then
INIT_TRIALS = 20  # first pairs that pycolmap tries on its own
ENOUGH = 0.8  # of the connected images: with so many, no other first pair is tried
FIRST_SHIFT = 0.2  # of the image's longest side: pairs nearer to each other are worth less


def local_sfm(
    features: Mapping[int, Features],
    keys: Mapping[int, str],
    cameras: Mapping[str, Camera],
    held: frozenset[str],
    matches: Mapping[tuple[int, int], Int],
    checkpoint: Callable[[], None] = lambda: None,
) -> SparseModel | None:
    """Return the largest model of the subset, or None when no three images hold together.

    `matches` are the verified ones (M, 2) of image pairs, rows of their features. Intrinsics of the camera keys in
    `held` stay as given; the others are refined in the bundle adjustment.
    `checkpoint` is called after every image that was added; what it raises ends the work.

    A model that leaves out images which matches connect is tried again: with looser demands, then from other first
    pairs. The largest one counts.
    """
    pycolmap = load_pycolmap()

    camera_ids = {key: number for number, key in enumerate(sorted(cameras), start=1)}
    cache = _database_cache(features, keys, cameras, camera_ids, matches)
    connected = _largest_connected(matches)
    best = None
    for attempt, options in enumerate(_attempts(features, matches)):
        options.constant_cameras = {camera_ids[key] for key in held if key in camera_ids}
        manager = pycolmap.ReconstructionManager()
        pipeline = pycolmap.IncrementalPipeline(options, cache, manager)
        for event in pycolmap.IncrementalPipelineCallback.__members__.values():
            pipeline.add_callback(int(event), checkpoint)
        pipeline.run()
        models = [manager.get(i) for i in range(manager.size())]
        largest = max(models, key=lambda model: model.num_reg_images(), default=None)
        if largest is not None and (best is None or largest.num_reg_images() > best.num_reg_images()):
            best = largest
        placed = 0 if best is None else best.num_reg_images()
        if connected < MIN_MODEL_SIZE or placed >= (connected if attempt == 0 else ENOUGH * connected):
            break
    if best is None or best.num_reg_images() < MIN_MODEL_SIZE:
        return None
    return _to_sparse_model(best, camera_ids)


def _largest_connected(matches: Mapping[tuple[int, int], Int]) -> int:
    """Return how many images the largest group has that matches connect."""
    group: dict[int, set[int]] = {}
    for (first, second), pairs in matches.items():
        if len(pairs):
            joined = group.get(first, {first}) | group.get(second, {second})
            group.update(dict.fromkeys(joined, joined))
    return max(map(len, group.values()), default=0)


def _first_pairs(features: Mapping[int, Features], matches: Mapping[tuple[int, int], Int]) -> list[tuple[int, int]]:
    """Return a few pairs to begin with that share no image: many matches, and far enough apart to be triangulated.

    How far is told by the shift in the middle of the similarity between the two images: over flat ground, and for
    cameras that look alike way down, it is the baseline over the height.
    """
    worth = {}
    for (first, second), pairs in matches.items():
        if len(pairs) >= MIN_FIRST_MATCHES:
            here, there = features[first].pixels[pairs[:, 0]], features[second].pixels[pairs[:, 1]]
            middle_here, middle_there = here.mean(axis=0), there.mean(axis=0)
            u, _, vt = np.linalg.svd((there - middle_there).T @ (here - middle_here))
            turn = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
            centre = 0.5 * (features[first].pixels.max(axis=0) + features[first].pixels.min(axis=0))
            shift = np.linalg.norm(turn @ (centre - middle_here) + middle_there - centre)
            worth[first, second] = len(pairs) * min(1.0, float(shift) / (FIRST_SHIFT * 2.0 * float(centre.max())))
    chosen: list[tuple[int, int]] = []
    for pair in sorted(worth, key=lambda pair: (-worth[pair], pair)):
        if len(chosen) < MORE_STARTS and not {i for other in chosen for i in other} & set(pair):
            chosen.append(pair)
    return chosen


def _attempts(features: Mapping[int, Features], matches: Mapping[tuple[int, int], Int]) -> Iterator[Any]:
    """Yield the options of one attempt after the other."""
    yield _pipeline_options()
    for pair in (None, *_first_pairs(features, matches)):
        options = _pipeline_options()
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.abs_pose_min_inlier_ratio = 0.15
        options.mapper.init_min_num_inliers = MIN_FIRST_MATCHES
        options.mapper.init_min_tri_angle = 4.0
        options.init_num_trials = INIT_TRIALS
        if pair is not None:
            options.init_image_id1, options.init_image_id2 = (index + 1 for index in pair)
        yield options


def _database_cache(
    features: Mapping[int, Features],
    keys: Mapping[int, str],
    cameras: Mapping[str, Camera],
    camera_ids: Mapping[str, int],
    matches: Mapping[tuple[int, int], Int],
) -> Any:
    pycolmap = load_pycolmap()

    database = pycolmap.Database.open(":memory:")
    for key, camera_id in camera_ids.items():
        database.write_camera(to_pycolmap_camera(cameras[key], camera_id), use_camera_id=True)
    for camera_id in camera_ids.values():
        rig = pycolmap.Rig(rig_id=camera_id)
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        database.write_rig(rig, use_rig_id=True)
    for index, image_features in features.items():
        image_id, camera_id = index + 1, camera_ids[keys[index]]
        database.write_image(
            pycolmap.Image(name=str(index), camera_id=camera_id, image_id=image_id),
            use_image_id=True,
        )
        frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_id)
        frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), image_id))
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(image_id, image_features.pixels)
    for (first, second), pairs in matches.items():
        if len(pairs):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = pairs.astype(np.uint32)
            database.write_two_view_geometry(first + 1, second + 1, geometry)
    cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    database.close()
    return cache


def _pipeline_options() -> Any:
    pycolmap = load_pycolmap()

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1  # with more, its random draws and sums differ from run to run
    options.random_seed = 0
    options.min_model_size = MIN_MODEL_SIZE
    options.multiple_models = False
    options.extract_colors = False
    # What follows does with fewer and looser adjustments: measured on subsets of real surveys, it halves the time,
    # and no camera moves by more than its error.
    options.ba_local_max_refinements = 1
    options.ba_local_function_tolerance = 1e-3
    options.mapper.ba_local_num_images = 4
    options.ba_global_max_refinements = 1
    options.ba_global_function_tolerance = 1e-4
    options.ba_global_frames_ratio = 2.0
    options.ba_global_points_ratio = 2.0
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _to_sparse_model(model: Any, camera_ids: Mapping[str, int]) -> SparseModel:
    point_ids = sorted(model.points3D)
    row = {point_id: i for i, point_id in enumerate(point_ids)}
    stored = [model.points3D[point_id] for point_id in point_ids]
    poses, tracks = {}, {}
    for image in model.images.values():
        if not image.has_pose:
            continue
        index = image.image_id - 1
        cam_from_local = image.cam_from_world()
        poses[index] = Rigid3(cam_from_local.rotation.matrix(), np.asarray(cam_from_local.translation)).inverse()
        seen = [(i, row[p.point3D_id]) for i, p in enumerate(image.points2D) if p.has_point3D()]
        table = np.array(seen, np.int64).reshape(-1, 2)
        tracks[index] = Track(table[:, 0], table[:, 1])
    used = model.cameras
    return SparseModel(
        local_from_cam=poses,
        cameras={key: _from_pycolmap(used[camera_id]) for key, camera_id in camera_ids.items() if camera_id in used},
        points=np.array([point.xyz for point in stored]).reshape(-1, 3),
        reprojection_px=np.array([point.error for point in stored]),
        track_length=np.array([point.track.length() for point in stored]),
        tracks=tracks,
        mean_reprojection_px=float(model.compute_mean_reprojection_error()),
    )


def _from_pycolmap(camera: Any) -> Camera:
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(p) for p in camera.params)
    return Camera(int(camera.width), int(camera.height), fx, fy, cx, cy, (k1, k2, p1, p2))
