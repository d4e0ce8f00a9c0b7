"""What a run's folder holds for the map: layers in their order, where their photographs are, what it is called."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from qgis.core import QgsProviderRegistry

from ..plugin.places import RESULTS, survey_name
from .base import tr

GEOPACKAGE = "survey.gpkg"
RECORD_BEGINNING = 256 * 1024  # bytes of run.json in which the folder of photographs is named
CLOUDS = (("cloud.copc.laz", "copc"), ("cloud.copc.laz", "pdal"), ("cloud.laz", "pdal"), ("cloud.las", "pdal"))


@dataclass(frozen=True)
class SurveyLayer:
    """A layer as QGIS loads it; those with the greater `height` lie above the others."""

    name: str
    title: str
    kind: str  # vector, raster, cloud
    height: int
    shown: bool = True
    style: str = ""
    uri: str = ""


# From the top down. The names are those of tables in the GeoPackage, and of files without their endings.
KNOWN = (
    SurveyLayer("rejected", "Rejected photographs", "vector", 90, style="rejected.qml"),
    SurveyLayer("cameras", "Cameras", "vector", 80, style="cameras.qml"),
    SurveyLayer("control", "Ground control", "vector", 70),
    SurveyLayer("footprints", "Footprints", "vector", 60, shown=False, style="footprints.qml"),
    SurveyLayer("orthophoto", "Orthophoto", "raster", 40),
    SurveyLayer("cloud", "Point cloud", "cloud", 30, style="cloud"),
    SurveyLayer("dsm", "Surface model (DSM)", "raster", 20, style="heights"),
    SurveyLayer("dtm", "Terrain model (DTM)", "raster", 10, shown=False, style="heights"),
)
HEIGHTS = {layer.name: layer.height for layer in KNOWN}
OTHER_TABLES = 50  # below the footprints, switched off
# Where there is no GeoPackage: tables that are parts of a shapefile.
SHAPEFILES = {
    "cameras": ("cameras.shp", "\"status\" = 'placed'"),
    "rejected": ("cameras.shp", "\"status\" = 'rejected'"),
    "footprints": ("footprints.shp", ""),
}


def survey_layers(run: Path, providers: Collection[str] | None = None) -> list[SurveyLayer]:
    """Return the layers that a run has and that this QGIS can show, from the top down.

    `providers` are the names of QGIS's data providers; those of this QGIS if not given.
    """
    providers = QgsProviderRegistry.instance().providerList() if providers is None else providers
    sources = {**_tables(run), **_rasters(run), **_cloud(run, providers)}
    known = {layer.name: layer for layer in KNOWN}
    found = [
        _placed(known.get(name) or SurveyLayer(name, _title(name), "vector", OTHER_TABLES, shown=False), uri)
        for name, uri in sources.items()
    ]
    return sorted(found, key=lambda layer: -layer.height)


def table_uri(run: Path, name: str) -> str:
    """Return where a table of a run is, empty when it has none: in its GeoPackage, or a shapefile."""
    return _tables(run).get(name, "")


def has_unreadable_cloud(run: Path, providers: Collection[str] | None = None) -> bool:
    """Return whether a run has a cloud that this QGIS has no reader for."""
    providers = QgsProviderRegistry.instance().providerList() if providers is None else providers
    return any((run / name).is_file() for name, _ in CLOUDS) and not _cloud(run, providers)


def shows_copc() -> bool:
    """Return whether this QGIS shows COPC files as they are."""
    return "copc" in QgsProviderRegistry.instance().providerList()


def photographs_folder(run: Path) -> Path | None:
    """Return the folder of photographs that a run was made from, None where it does not say, or it is gone."""
    try:
        with (run / "work" / "run.json").open(encoding="utf-8", errors="replace") as stream:
            beginning = stream.read(RECORD_BEGINNING)
        told = re.search(r'(?<!\\)"photos": ("(?:[^"\\]|\\.)*")', beginning)
        folder = Path(json.loads(told.group(1))) if told else None
        return folder if folder is not None and folder.name and folder.is_dir() else None
    except (OSError, ValueError):
        return None


def survey_title(run: Path, photos: Path | None) -> str:
    """Return what the group of a run is called: its survey, with the number of the run where there are several."""
    number = re.fullmatch(rf".* {RESULTS}( \d+)", run.name)
    if photos is None:
        return run.name
    return survey_name(photos.absolute()) + (number.group(1) if number else "")


def _placed(layer: SurveyLayer, uri: str) -> SurveyLayer:
    return SurveyLayer(layer.name, tr(layer.title), layer.kind, layer.height, layer.shown, layer.style, uri)


def _title(name: str) -> str:
    return name[0].upper() + name[1:].replace("_", " ")


def _tables(run: Path) -> dict[str, str]:
    package = run / GEOPACKAGE
    if package.is_file():
        return {name: f"{package}|layername={name}" for name in _table_names(package)}
    tables = {}
    for name, (file, subset) in SHAPEFILES.items():
        if (run / file).is_file():
            tables[name] = f"{run / file}|subset={subset}" if subset else str(run / file)
    return tables


def _table_names(package: Path) -> list[str]:
    metadata = QgsProviderRegistry.instance().providerMetadata("ogr")
    details = metadata.querySublayers(str(package))
    return [layer.name() for layer in details if layer.name() != "layer_styles"]


def _rasters(run: Path) -> dict[str, str]:
    names = [layer.name for layer in KNOWN if layer.kind == "raster"]
    return {name: str(run / f"{name}.tif") for name in names if (run / f"{name}.tif").is_file()}


def _cloud(run: Path, providers: Collection[str]) -> dict[str, str]:
    found = [str(run / name) for name, provider in CLOUDS if provider in providers and (run / name).is_file()]
    return {"cloud": found[0]} if found else {}
