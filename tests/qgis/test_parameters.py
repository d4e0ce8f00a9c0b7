"""From what the user enters to the options of the core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def options_of(qgis: Any, plugin: Any) -> Any:
    """The options of an algorithm for some parameters."""
    from qgis.core import QgsApplication, QgsProcessingContext

    def options(name: str, parameters: dict[str, Any], **more: Any) -> dict[str, Any]:
        algorithm = QgsApplication.processingRegistry().algorithmById(f"onthefly3r:{name}").create()
        return dict(
            plugin("processing_algorithms.parameters").options_from(
                algorithm, parameters, QgsProcessingContext(), **more
            )
        )

    return options


def test_nothing_named_leaves_the_defaults_of_the_core(options_of: Any) -> None:
    assert options_of("reconstruct", {}) == {}
    assert options_of("exportcloud", {}) == {}


def test_quality_sets_sizes_and_named_ones_go_before_it(options_of: Any) -> None:
    preview = {"quality": "preview", "working_px": 600, "dense_px": 250, "features": 2000, "orthophoto": "fast"}
    assert options_of("reconstruct", {"QUALITY": "preview"}) == preview
    named = {"QUALITY": "preview", "WORKING_PX": 1000, "OPTIONS": "dense_px=300 quality=standard orthophoto=none"}
    assert options_of("reconstruct", named) == {"dense_px": 300, "features": 2000, "orthophoto": "none"}
    assert options_of("reconstruct", {"QUALITY": "standard", "OPTIONS": "preset=paper"}) == {"preset": "paper"}


def test_values_have_the_types_of_the_core(options_of: Any, plugin: Any, tmp_path: Path) -> None:
    parameters = {
        "CRS": "EPSG:25833",
        "VERTICAL": "egm96",
        "BACKBONE": "pi3",
        "OPTIONS": "preset=paper seed-size=20\nspacing_m=0.25, stray_filter = no",
        "WEIGHTS": "owner/name@abc",
        "POSITIONS": str(tmp_path / "geo.txt"),
    }
    (tmp_path / "geo.txt").write_text("EPSG:4326")
    named = options_of("reconstruct", parameters)
    assert named == {
        "crs": "EPSG:25833",
        "vertical": "egm96",
        "backbone": "pi3",
        "preset": "paper",
        "seed_size": 20,
        "spacing_m": 0.25,
        "stray_filter": False,
        "weights": "owner/name@abc",
        "positions": str(tmp_path / "geo.txt"),
    }
    assert plugin("core.onthefly3r.options").Options.from_flat(named).selection.seed_size == 20


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("SPACING_M", "Distance of points [m]"),
        ("MIN_CONFIDENCE", "Least confidence of a point, 0 to 1"),
    ],
)
def test_titles(qgis: Any, name: str, title: str) -> None:
    from qgis.core import QgsApplication

    algorithm = QgsApplication.processingRegistry().algorithmById("onthefly3r:exportcloud")
    assert algorithm.parameterDefinition(name).description() == title


def test_degrees_are_refused(options_of: Any) -> None:
    from qgis.core import QgsProcessingException

    with pytest.raises(QgsProcessingException, match="in degrees"):
        options_of("reconstruct", {"CRS": "EPSG:4326"})


def test_a_crs_of_the_user_goes_as_wkt(options_of: Any) -> None:
    proj = "PROJ:+proj=tmerc +lat_0=0 +lon_0=15.5 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m"
    assert options_of("reconstruct", {"CRS": proj})["crs"].startswith("PROJ")


def test_georeferencing_again_keeps_what_is_left_as_it_is(options_of: Any) -> None:
    named = options_of("georeference", {}, every=True)
    assert named == {"local": False, "format": "laz"}
    assert options_of("georeference", {"VERTICAL": "auto"}, every=True)["vertical"] == "auto"


def test_boundary_is_handed_over_in_degrees(qgis: Any, plugin: Any) -> None:
    import json

    from qgis.core import (
        QgsApplication,
        QgsFeature,
        QgsGeometry,
        QgsProcessingContext,
        QgsProcessingException,
        QgsRectangle,
        QgsVectorLayer,
    )

    layer = QgsVectorLayer("Polygon?crs=EPSG:32633", "area", "memory")
    feature = QgsFeature()
    feature.setGeometry(QgsGeometry.fromRect(QgsRectangle(500000, 5000000, 501000, 5001000)))
    layer.dataProvider().addFeature(feature)
    algorithm = QgsApplication.processingRegistry().algorithmById("onthefly3r:reconstruct").create()
    boundary_file = plugin("processing_algorithms.boundary").boundary_file
    extent = "500500,502000,4999000,5002000 [EPSG:32633]"
    with boundary_file(algorithm, {"BOUNDARY": layer, "EXTENT": extent}, QgsProcessingContext()) as path:
        geometry = json.loads(Path(path).read_text(encoding="utf-8"))["features"][0]["geometry"]
    assert not Path(path).exists()
    lon, lat = (axis[1:-1] for axis in zip(*geometry["coordinates"][0], strict=True))
    assert 15.0063 < min(lon) < 15.0065 and 15.0126 < max(lon) < 15.0128
    assert 45.15 < min(lat) < max(lat) < 45.17
    with boundary_file(algorithm, {}, QgsProcessingContext()) as path:
        assert path is None
    far = {"BOUNDARY": layer, "EXTENT": "0,1,0,1 [EPSG:32633]"}
    with (
        pytest.raises(QgsProcessingException, match="holds no ground"),
        boundary_file(algorithm, far, QgsProcessingContext()),
    ):
        pass
    with (
        pytest.raises(QgsProcessingException, match="no coordinate reference system"),
        boundary_file(algorithm, {"EXTENT": "0,1,0,1"}, QgsProcessingContext()),
    ):
        pass


@pytest.mark.parametrize("given", ["full", "FULL", 2, "2"])
def test_choices_are_words_or_numbers(options_of: Any, given: Any) -> None:
    assert options_of("reconstruct", {"QUALITY": given})["working_px"] == 1600
    assert options_of("reconstruct", {"VERTICAL": 2}) == {"vertical": "egm96"}


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("", {}),
        ("threads=2", {"threads": 2}),
        ("--threads=2; --min-confidence=1", {"threads": 2, "min_confidence": 1.0}),
        ("# for the office\nWORKING_PX = 800\nrecursive = No\n", {"working_px": 800, "recursive": False}),
        ("crs=EPSG:25833 weights='/with blank/x y.pt', device=cuda", {
            "crs": "EPSG:25833", "weights": "/with blank/x y.pt", "device": "cuda"}),
        (r"weights=C:\models\da3 small.safetensors", {"weights": r"C:\models\da3 small.safetensors"}),
        ("limit=", {"limit": None}),
    ],
)  # fmt: skip
def test_further_options(plugin: Any, text: str, options: dict[str, Any]) -> None:
    if "weights" in options:
        text, options = f"backbone=pi3 {text}", {"backbone": "pi3", **options}
    assert plugin("processing_algorithms.option_text").read_options(text) == options


def test_further_options_from_a_file(plugin: Any, tmp_path: Path) -> None:
    preset = tmp_path / "büro preset.txt"
    preset.write_text("# ours\nthreads=2\nspacing_m=0.1\n", encoding="utf-8-sig")
    read = plugin("processing_algorithms.option_text").read_options
    assert read(str(preset)) == read(f'"{preset}"') == {"threads": 2, "spacing_m": 0.1}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("thread=2", "did you mean threads"),
        ("threads=two", "'two' is no whole number"),
        ("threads=1.5", "'1.5' is no whole number"),
        ("threads=-1", "below the minimum"),
        ("spacing_m=fine", "'fine' is no number"),
        ("spacing_m=nan", "not a finite number"),
        ("recursive=perhaps", "recursive: 'perhaps' is not a bool"),
        ("format=ply", "not one of laz"),
        ("preset=mine", "preset: 'mine' is not one of"),
        ("fast threads=2", "'fast' is not an option"),
        ("threads=1 threads=2", "threads is named twice"),
        ("no such file", "neither name=value nor a file"),
        ("local=yes crs=EPSG:25833", "use only one of the two"),
    ],
)
def test_wrong_further_options_are_told(plugin: Any, text: str, told: str) -> None:
    with pytest.raises(plugin("core.onthefly3r.errors").OptionError, match=told):
        plugin("processing_algorithms.option_text").read_options(text)
