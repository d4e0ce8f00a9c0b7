"""Every product of a run: its name, its files, when it is wanted, how it is written, how QGIS shows it.

Writing, removal, export, the report and, by way of the report, QGIS read this list: a new product is one module and
one entry here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..geometry.arrays import Int
from ..options import ExportOptions
from .cloudpass import Cloud, Sink
from .copc import CopcWriter
from .exchange import EXCHANGE_FILES, write_exchange
from .footprints import write_footprints
from .geopackage import write_geopackage
from .heightmodels import SurfaceSink
from .las import CloudWriter, las_scale_m
from .orthophoto import OrthoSummary, write_orthophoto
from .preview import write_preview
from .runview import RunView, raster_tags
from .sparsepoints import write_colmap
from .trajectory_table import write_trajectory
from .vector import write_cameras

CLOUD_FILES = ("cloud.laz", "cloud.las", "cloud.copc.laz")


@dataclass(frozen=True)
class Layer:
    """How QGIS loads a product; layers with the greater `height` lie above the others."""

    file: str
    title: str
    kind: Literal["vector", "raster", "point cloud"]
    height: int
    table: str = ""  # in a GeoPackage
    style: str = ""  # file in products/styles
    shown: bool = True  # False: among the layers, but switched off


@dataclass(frozen=True)
class Product:
    """One product; it has a `sink` for the tiles of the cloud, or is written by `write` when the cloud is done.

    What `write` returns, or the `summary` of the sink, is what later products and the report get under its name.
    """

    name: str
    title: str
    files: tuple[str, ...]  # relative to the output folder: all that it may write
    wanted: Callable[[ExportOptions], bool]
    write: Callable[[Path, RunView, Mapping[str, Any]], Any] | None = None
    sink: Callable[[Path, RunView, Cloud], Sink] | None = None
    layers: tuple[Layer, ...] = ()


def product(name: str) -> Product:
    """Return the product of this name; raises `KeyError`."""
    return next(item for item in PRODUCTS if item.name == name)


def layers_in(folder: Path, made: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the layers of a folder of products from the top down, as JSON values; tables without rows are left out.

    `made` is what `writing.write_products` returned.
    """
    rows = made.get("geopackage") or {}
    layers = [layer for item in PRODUCTS for layer in item.layers if (folder / layer.file).is_file()]
    return [
        {
            "name": layer.title,
            "path": layer.file,
            "table": layer.table or None,
            "kind": layer.kind,
            "style": layer.style or None,
            "shown": layer.shown,
        }
        for layer in sorted(layers, key=lambda layer: -layer.height)
        if not layer.table or rows.get(layer.table)
    ]


def _always(export: ExportOptions) -> bool:
    return True


def _with_cloud(export: ExportOptions) -> bool:
    return export.cloud


def _with_surface(export: ExportOptions) -> bool:
    return export.cloud and (export.rasters or export.orthophoto != "none")


def _with_orthophoto(export: ExportOptions) -> bool:
    return export.cloud and export.orthophoto != "none"


def _shapefile(name: str) -> tuple[str, ...]:
    return tuple(f"{name}.{suffix}" for suffix in ("shp", "shx", "dbf", "prj", "cpg"))


def _cloud(out: Path, view: RunView, cloud: Cloud) -> Sink:
    scale_m, wkt, images = las_scale_m(cloud.spacing_m), view.frame.wkt, len(view.shots)
    if view.options.export.format == "copc":
        path = out / "cloud.copc.laz"
        return CopcWriter(
            path, view.work, cloud.extent, cloud.spacing_m, wkt, scale_m, view.title, images, _parts(view)
        )
    return CloudWriter(out / f"cloud.{view.options.export.format}", wkt, scale_m, view.title, images, _parts(view))


def _parts(view: RunView) -> Int | None:
    """Return the part of the map that each photograph lies in, None where the map is one."""
    if all(camera.part == 1 for camera in view.cameras):
        return None
    table = np.zeros(1 + max(camera.index for camera in view.cameras), np.int64)
    table[[camera.index for camera in view.cameras]] = [camera.part for camera in view.cameras]
    return table


def _surface(out: Path, view: RunView, cloud: Cloud) -> Sink:
    return SurfaceSink(
        out,
        view.work,
        cloud.extent,
        view.options.export.raster_m or cloud.spacing_m,
        cloud.terrain,
        view.crs,
        view.options.export.fill_holes,
        raster_tags(view),
    )


def _orthophoto(out: Path, view: RunView, made: Mapping[str, Any]) -> OrthoSummary | None:
    return write_orthophoto(out, view, made["surface"], raster_tags(view))


def _cameras(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_cameras(out / "cameras.shp", view.rows, view.crs)


def _footprints(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_footprints(out / "footprints.shp", view.footprints, view.crs)


def _geopackage(out: Path, view: RunView, made: Mapping[str, Any]) -> dict[str, int]:
    return write_geopackage(
        out / "survey.gpkg",
        view.rows,
        view.footprints,
        view.crs,
        photographs={index + 1: shot.path for index, shot in view.shots.items()},
        control=view.control,
    )


def _trajectory(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_trajectory(out / "trajectory.csv", view.rows)


def _model(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_colmap(out / "colmap", view.cameras, view.state, view.store, view.shots, view.frame)


def _exchange(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_exchange(out, view.cameras, view.rows, view.crs)


def _preview(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_preview(
        out / "preview.png", made["cloud"], view.rows, view.title, georeferenced=view.crs is not None, unit=view.unit
    )


PRODUCTS: tuple[Product, ...] = (
    Product(
        "cloud",
        "Point cloud",
        CLOUD_FILES,
        _with_cloud,
        sink=_cloud,
        layers=tuple(Layer(name, "Point cloud", "point cloud", 30) for name in CLOUD_FILES),
    ),
    Product(
        "surface",
        "Surface and terrain model",
        ("dsm.tif", "dtm.tif", "confidence.tif"),
        _with_surface,
        sink=_surface,
        layers=(
            Layer("dsm.tif", "Surface model", "raster", 20, shown=False),
            Layer("dtm.tif", "Terrain model", "raster", 10, shown=False),
            Layer("confidence.tif", "Confidence", "raster", 9, shown=False),
        ),
    ),
    Product(
        "orthophoto",
        "Orthophoto",
        ("orthophoto.tif", "overlap.tif", "gsd.tif"),
        _with_orthophoto,
        _orthophoto,
        layers=(
            Layer("orthophoto.tif", "Orthophoto", "raster", 40),
            Layer("overlap.tif", "Overlap", "raster", 8, shown=False),
            Layer("gsd.tif", "Ground sampling distance", "raster", 7, shown=False),
        ),
    ),
    Product("cameras", "Cameras", _shapefile("cameras"), _always, _cameras),
    Product("footprints", "Footprints", _shapefile("footprints"), _always, _footprints),
    Product(
        "geopackage",
        "Cameras, rejected photographs, control, footprints and coverage",
        ("survey.gpkg",),
        _always,
        _geopackage,
        layers=(
            Layer("survey.gpkg", "Rejected photographs", "vector", 90, "rejected", "rejected.qml"),
            Layer("survey.gpkg", "Cameras", "vector", 80, "cameras", "cameras.qml"),
            Layer("survey.gpkg", "Ground control", "vector", 70, "control"),
            Layer("survey.gpkg", "Footprints", "vector", 60, "footprints", "footprints.qml", shown=False),
            Layer("survey.gpkg", "Fly here again", "vector", 55, "fly_again", shown=False),
            Layer("survey.gpkg", "Covered ground", "vector", 50, "coverage", shown=False),
        ),
    ),
    Product("trajectory", "Camera poses as a table", ("trajectory.csv",), _always, _trajectory),
    Product(
        "colmap",
        "COLMAP model",
        (
            *(f"colmap/{name}.{suffix}" for name in ("cameras", "images", "points3D") for suffix in ("txt", "bin")),
            "colmap/offset.txt",
            "colmap/offset.json",
        ),
        _always,
        _model,
    ),
    Product("exchange", "Cameras for other programs", EXCHANGE_FILES, _always, _exchange),
    Product("preview", "Preview picture", ("preview.png",), _with_cloud, _preview),
    Product("report", "Report", ("report.json", "report.html"), _always),  # written last by the run, whatever happens
)
