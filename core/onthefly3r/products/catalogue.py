"""Every product of a run: its name, its files, when it is wanted, how it is written, how QGIS shows it.

Writing, removal, export, the report and, by way of the report, QGIS read this list: a new product is one module and
one entry here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..options import ExportOptions
from .cloudpass import Sink, cloud_spacing_m
from .footprints import write_footprints
from .las import CloudWriter, las_scale_m
from .preview import write_preview
from .runview import RunView
from .sparsepoints import write_colmap
from .trajectory_table import write_trajectory
from .vector import write_cameras


@dataclass(frozen=True)
class Layer:
    """How QGIS loads a product; layers with the greater `height` lie above the others."""

    kind: Literal["vector", "raster", "point cloud"]
    height: int
    style: str = ""  # file in resources/styles
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
    sink: Callable[[Path, RunView], Sink] | None = None
    layer: Layer | None = None


def product(name: str) -> Product:
    """Return the product of this name; raises `KeyError`."""
    return next(item for item in PRODUCTS if item.name == name)


def _always(export: ExportOptions) -> bool:
    return True


def _with_cloud(export: ExportOptions) -> bool:
    return export.cloud


def _shapefile(name: str) -> tuple[str, ...]:
    return tuple(f"{name}.{suffix}" for suffix in ("shp", "shx", "dbf", "prj", "cpg"))


def _cloud(out: Path, view: RunView) -> Sink:
    return CloudWriter(
        out / f"cloud.{view.options.export.format}",
        view.frame.wkt,
        las_scale_m(cloud_spacing_m(view)),
        view.title,
        n_images=len(view.shots),
    )


def _cameras(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_cameras(out / "cameras.shp", view.rows, view.crs)


def _footprints(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_footprints(out / "footprints.shp", view.footprints, view.crs)


def _trajectory(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_trajectory(out / "trajectory.csv", view.rows)


def _model(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_colmap(out / "colmap", view.cameras, view.state, view.store, view.shots, view.frame)


def _preview(out: Path, view: RunView, made: Mapping[str, Any]) -> None:
    write_preview(
        out / "preview.png", made["cloud"], view.rows, view.title, georeferenced=view.crs is not None, unit=view.unit
    )


PRODUCTS: tuple[Product, ...] = (
    Product(
        "cloud", "Point cloud", ("cloud.laz", "cloud.las"), _with_cloud, sink=_cloud, layer=Layer("point cloud", 20)
    ),
    Product("cameras", "Cameras", _shapefile("cameras"), _always, _cameras, layer=Layer("vector", 60, "cameras.qml")),
    Product(
        "footprints",
        "Footprints",
        _shapefile("footprints"),
        _always,
        _footprints,
        layer=Layer("vector", 40, "footprints.qml", shown=False),
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
    Product("preview", "Preview picture", ("preview.png",), _with_cloud, _preview),
    Product("report", "Report", ("report.json", "report.html"), _always),  # written last by the run, whatever happens
)
