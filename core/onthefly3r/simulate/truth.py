"""What a simulated survey really looks like: cameras as a COLMAP model, the surface as a LAS cloud."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..files.atomic import write_text
from ..geometry.arrays import Bool, Float, UInt8
from ..geometry.geodesy import WorldFrame, utm_crs_for, wkt1
from ..products.colmap import SparsePoints, write_model
from ..products.las import write_cloud
from ..records import CloudTile, PlacedCamera
from .flight import Survey, TrueView, tag_vertical

CLOUD_POINTS = 300_000
MODEL_POINTS = 2_000  # in points3D.txt
MIN_VIEWS = 3  # the cloud is what so many photographs have in their frame


def write_truth(survey: Survey, folder: Path) -> None:
    """Write a COLMAP model of the cameras (local ENU, m), origin.json and cloud.las into a folder.

    The cloud is in the UTM zone of the origin, with heights as in the photographs' tags. origin.json names the
    WGS 84 position of the ENU origin, that zone (`crs`) and the height reference of the cloud (`vertical`).
    """
    world = truth_frame(survey)
    points, rgb, in_frame = truth_cloud(survey)
    views = in_frame.sum(axis=1)
    some = slice(MODEL_POINTS)
    point, image = np.nonzero(in_frame[some])
    pixels = np.stack([_pixels(view, points[some]) for view in survey.views], axis=1)[point, image]
    cameras = [
        PlacedCamera(i, view.name, view.camera, view.enu_from_cam, batch=0) for i, view in enumerate(survey.views)
    ]
    sparse = SparsePoints(points[some], rgb[some], np.zeros(len(points[some])), point, image, pixels)
    write_model(folder, cameras, sparse)
    count = len(points)
    tile = CloudTile(
        world.from_enu(points), rgb, np.ones(count), source=np.full(count, -1), batch=np.zeros(count), views=views
    )
    write_cloud(folder / "cloud.las", iter([tile]), wkt1(world.crs, world.vertical), 0.001, "truth of a simulation")
    place = {**asdict(survey.origin), "crs": world.crs, "vertical": world.vertical}
    write_text(folder / "origin.json", json.dumps(place, indent=2) + "\n")


def truth_frame(survey: Survey) -> WorldFrame:
    """Return the frame of the truth cloud: the origin's UTM zone, heights as in the photographs' tags."""
    origin = survey.origin
    return WorldFrame(utm_crs_for(origin.lat_deg, origin.lon_deg), tag_vertical(survey.options), origin)


def truth_cloud(survey: Survey, count: int = CLOUD_POINTS, seed: int = 0) -> tuple[Float, UInt8, Bool]:
    """Return points (N, 3) ENU m under the open sky, their colours (N, 3), and which views (N, V) frame them.

    Only points that at least three views have in their frame; houses between are not looked for.
    """
    hits = survey.scene.sample_surface(count, seed)
    in_frame = np.zeros((len(hits.points), len(survey.views)), bool)
    for index, view in enumerate(survey.views):
        pixels = _pixels(view, hits.points)
        with np.errstate(invalid="ignore"):
            in_frame[:, index] = np.all((pixels > 0.0) & (pixels < (view.camera.width, view.camera.height)), axis=-1)
    seen = in_frame.sum(axis=1) >= MIN_VIEWS
    return hits.points[seen], survey.scene.colour(hits)[seen], in_frame[seen]


def _pixels(view: TrueView, points: Float) -> Float:
    return view.camera.project(view.enu_from_cam.inverse().apply(points))
