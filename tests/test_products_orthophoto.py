"""Surface model, terrain model and orthophoto of a rendered survey whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio

from onthefly3r.earth.georef import world_frame
from onthefly3r.geometry.transforms import Sim3
from onthefly3r.intake.folder import read_photographs
from onthefly3r.options import IntakeOptions, Options
from onthefly3r.products.exportframe import ExportFrame
from onthefly3r.products.footprints import footprint, with_overlap
from onthefly3r.products.heightmodels import NODATA, SurfaceRasters, SurfaceSink
from onthefly3r.products.orthophoto import write_orthophoto
from onthefly3r.products.spool import Extent
from onthefly3r.products.terrain import LowestPoints, find_terrain
from onthefly3r.records import CloudTile, GeoReference, PlacedCamera
from onthefly3r.simulate import Survey, plan_survey
from onthefly3r.simulate.flight import SurveyOptions
from onthefly3r.simulate.photographs import render, write_photograph
from onthefly3r.simulate.scene import GROUND

GAIN = 0.7  # of the exposure of every second photograph


@dataclass(frozen=True)
class Made:
    """A survey, its rasters and how they came about."""

    survey: Survey
    view: Any
    surface: SurfaceRasters
    summary: Any
    tile: CloudTile
    truth_ground: np.ndarray
    folder: Path

    @cached_property
    def ortho(self) -> np.ndarray:
        with rasterio.open(self.folder / "orthophoto.tif") as dataset:
            return np.asarray(dataset.read())

    def truth(self, name: str) -> tuple[Any, np.ndarray]:
        """What rays straight down hit at the pixels of a raster, and the hits' shape."""
        with rasterio.open(self.folder / name) as dataset:
            place, shape = dataset.transform, dataset.shape
        x = place.c + (np.arange(shape[1]) + 0.5) * place.a
        y = place.f + (np.arange(shape[0]) + 0.5) * place.e
        level = self.view.frame.world.to_enu(
            np.stack([*np.meshgrid(x, y), np.full(shape, 100.0)], axis=-1).reshape(-1, 3)
        )
        level[:, 2] = 100.0
        return self.survey.scene.cast(level, np.tile([0.0, 0.0, -1.0], (len(level), 1))), np.array(shape)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("ortho ü")
    survey = plan_survey(SurveyOptions(images=9, strips=3, image_width_px=480, image_height_px=360))
    for number, item in enumerate(survey.views):
        exposure = GAIN if number % 2 else 1.0
        rgb = (render(survey.scene, item).astype(float) * exposure).astype(np.uint8)
        write_photograph(folder / "photos" / item.name, rgb, item)
    shots, _ = read_photographs(folder / "photos", IntakeOptions())
    by_name = {item.name: item for item in survey.views}
    reference = GeoReference(
        Sim3(), survey.origin.lat_deg, survey.origin.lon_deg, survey.origin.height_m, "EPSG:32633", "ellipsoidal",
        "truth", 9, 0, 0.0, 0.0,
    )  # fmt: skip
    frame = ExportFrame(Sim3(), world_frame(reference))
    poses = {index: by_name[shot.name].enu_from_cam for index, shot in enumerate(shots)}
    cameras = [
        PlacedCamera(index, shot.name, by_name[shot.name].camera, frame.pose(poses[index]), 0)
        for index, shot in enumerate(shots)
    ]
    hits = survey.scene.sample_surface(500_000, 0)
    points = frame.from_level(hits.points)
    low, high = (np.array([*ends, z]) for ends, z in zip(_inner_box(cameras), (0.0, 1e4), strict=True))
    inside = ((points >= low) & (points <= high)).all(axis=1)
    points, ground = points[inside], survey.scene.material[hits.faces[inside]] == GROUND
    lowest = LowestPoints(0.3)
    lowest.add(points)
    extent = Extent(points.min(axis=0), points.max(axis=0))
    terrain = find_terrain(lowest, extent)
    count = len(points)
    tile = CloudTile(
        points=points,
        rgb=np.zeros((count, 3), np.uint8),
        confidence=np.full(count, 0.75, np.float32),
        source=np.zeros(count, np.int32),
        batch=np.zeros(count, np.int32),
        views=np.full(count, 3, np.int32),
        classification=np.where(terrain.is_ground(points), 2, 1).astype(np.uint8),
    )
    view = SimpleNamespace(
        options=Options(),
        frame=frame,
        crs=reference.crs,
        shots=dict(enumerate(shots)),
        cameras=cameras,
        footprints=with_overlap(
            [f for c in cameras if (f := footprint(c, float(np.median(points[:, 2])))) is not None]
        ),
        state=SimpleNamespace(map_from_cam=poses.__getitem__),
        checkpoint=lambda stage, done, total: None,
    )
    with SurfaceSink(folder, folder / "work", extent, 0.3, terrain, reference.crs, 0.0, {"HEIGHTS": "told"}) as sink:
        for part in np.array_split(np.argsort(points[:, 0]), 4):
            sink.add(tile.only(part))
    assert sink.summary is not None
    summary = write_orthophoto(folder, view, sink.summary, {})  # type: ignore[arg-type]
    return Made(survey, view, sink.summary, summary, tile, ground, folder)


def _inner_box(cameras: list[PlacedCamera]) -> tuple[np.ndarray, np.ndarray]:
    centres = np.array([c.world_from_cam.translation[:2] for c in cameras])
    return centres.min(axis=0) - 15.0, centres.max(axis=0) + 15.0


def kappa(found: np.ndarray, true: np.ndarray) -> float:
    agreed = float((found == true).mean())
    chance = float(found.mean() * true.mean() + (1 - found.mean()) * (1 - true.mean()))
    return (agreed - chance) / (1.0 - chance)


def test_ground_is_told_from_houses_and_trees(made: Made) -> None:
    assert 0.3 < made.truth_ground.mean() < 0.98
    assert kappa(made.tile.classification == 2, made.truth_ground) >= 0.9


def test_rasters_are_cloud_optimized_and_say_what_they_are(made: Made) -> None:
    names = ("dsm", "dtm", "confidence", "orthophoto", "overlap", "gsd")
    for name in names:
        with rasterio.open(made.folder / f"{name}.tif") as dataset:
            assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert dataset.crs.to_epsg() == 32633
            if max(dataset.shape) > 512:
                assert dataset.overviews(1)
            assert dataset.block_shapes[0] == (512, 512)
    with rasterio.open(made.folder / "dsm.tif") as dataset:
        assert dataset.nodata == NODATA
        assert dataset.tags()["HEIGHTS"] == "told"
    with rasterio.open(made.folder / "orthophoto.tif") as dataset:
        assert [c.name for c in dataset.colorinterp] == ["red", "green", "blue", "alpha"]
    assert sorted(path.name for path in made.folder.glob(".*")) == []


def test_surface_and_terrain_are_within_a_pixel_of_the_truth(made: Made) -> None:
    hits, shape = made.truth("dsm.tif")
    true = made.view.frame.from_level(hits.points)[:, 2].reshape(shape)
    kind = np.where(hits.faces >= 0, made.survey.scene.material[hits.faces], -1).reshape(shape)
    with rasterio.open(made.folder / "dsm.tif") as dataset:
        dsm = dataset.read(1)
    known = (dsm != NODATA) & (kind == GROUND)
    assert known.mean() > 0.5
    error = np.abs(dsm - true)[known]
    assert np.quantile(error, 0.9) < 0.3
    with rasterio.open(made.folder / "dtm.tif") as dataset:
        dtm = dataset.read(1)
    known = (dtm != NODATA) & (kind == GROUND)
    assert np.sqrt(np.mean((dtm - true)[known] ** 2)) < 0.3
    below = (dtm != NODATA) & (kind > GROUND)
    assert below.any()
    assert np.median((true - dtm)[below]) > 1.0  # houses and trees stand on it, not in it


def test_orthophoto_lies_on_the_truth_in_evened_colours(made: Made) -> None:
    import cv2

    hits, shape = made.truth("orthophoto.tif")
    true = made.survey.scene.colour(hits, made.summary.pixel_m).reshape(*shape, 3).astype(float)
    alpha = made.ortho[3] > 0
    assert alpha.mean() > 0.9
    ortho = made.ortho[:3].transpose(1, 2, 0).astype(float)
    kind = np.where(hits.faces >= 0, made.survey.scene.material[hits.faces], -1).reshape(shape)
    ground = cv2.erode((alpha & (kind == GROUND)).astype(np.uint8), np.ones((5, 5))) > 0
    grey, true_grey = ortho.mean(axis=2), true.mean(axis=2)
    scale = np.median(grey[ground]) / np.median(true_grey[ground])
    left = np.abs(grey - scale * true_grey)[ground] / np.median(grey[ground])
    assert np.median(left) < 0.08
    # Shifted by as little as two pixels either way it fits worse.
    best = np.median(left)
    for shift in ((0, 2), (2, 0), (0, -2), (-2, 0)):
        moved = np.roll(true_grey, shift, axis=(0, 1))
        assert np.median(np.abs(grey - scale * moved)[ground]) / np.median(grey[ground]) > best
    assert made.summary.colour_difference < 0.03 < made.summary.colour_difference_before


def test_overlap_counts_photographs_and_sampling_distance_is_that_of_the_flight(made: Made) -> None:
    with rasterio.open(made.folder / "overlap.tif") as dataset:
        overlap = dataset.read(1)
    assert overlap.max() <= len(made.view.cameras)
    assert overlap.max() >= 4
    with rasterio.open(made.folder / "gsd.tif") as dataset:
        gsd = dataset.read(1)
    camera = made.survey.views[0].camera
    assert np.median(gsd[gsd > 0]) == pytest.approx(80.0 / camera.fx, rel=0.15)


def test_missing_photographs_are_named_and_the_rest_is_used(made: Made, tmp_path: Path) -> None:
    lost = made.view.shots[4]
    hidden = lost.path.with_suffix(".away")
    lost.path.rename(hidden)
    try:
        summary = write_orthophoto(tmp_path, made.view, made.surface, {})
    finally:
        hidden.rename(lost.path)
    assert summary is not None
    assert summary.missing == (lost.name,)
    with rasterio.open(tmp_path / "orthophoto.tif") as dataset:
        assert (dataset.read(4) > 0).mean() > 0.8
