"""Cutting a cloud to GeoJSON polygons, against shapes whose area and place are known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import shapely

from onthefly3r.errors import InputError
from onthefly3r.products.clip import Boundary, clipped, in_ring, read_boundary, require_boundary_near
from onthefly3r.records import CloudTile, GpsFix, Shot

CRS = "EPSG:32633"


def lonlat(points: list[tuple[float, float]]) -> list[list[float]]:
    """Closed ring of projected points in longitude and latitude, by a transformer of its own."""
    back = pyproj.Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    return [list(back.transform(x, y)) for x, y in [*points, points[0]]]


def square(x: float, y: float, half: float) -> list[tuple[float, float]]:
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


def write(path: Path, geometry: object) -> Path:
    path.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}), encoding="utf-8")
    return path


def test_polygon_with_a_hole_and_a_second_part(tmp_path: Path) -> None:
    parts = [
        [lonlat(square(500_000, 5_300_000, 100)), lonlat(square(500_000, 5_300_000, 50))],
        [lonlat(square(501_000, 5_300_000, 10))],
    ]
    boundary = read_boundary(write(tmp_path / "b.json", {"type": "MultiPolygon", "coordinates": parts}), CRS)
    points = np.array(
        [[500_075.0, 5_300_000, 9], [500_000, 5_300_000, 9], [501_000, 5_300_000, 9], [500_101, 5_300_000, 9]]
    )
    assert boundary.contains(points).tolist() == [True, False, True, False]


@pytest.mark.parametrize("kind", ["features", "multipolygon"])
def test_polygons_that_overlap_are_joined(tmp_path: Path, kind: str) -> None:
    """A polygon in another, and one given twice, add nothing and take nothing away."""
    rings = [[lonlat(square(500_000 + dx, 5_300_000, 100))] for dx in (0, 0, 100)]
    if kind == "multipolygon":
        text = json.dumps({"type": "MultiPolygon", "coordinates": rings})
    else:
        polygons = [{"type": "Polygon", "coordinates": polygon} for polygon in rings]
        features = [{"type": "Feature", "properties": None, "geometry": polygon} for polygon in polygons]
        text = json.dumps({"type": "FeatureCollection", "features": features})
    (tmp_path / "b.json").write_text(text, encoding="utf-8-sig")
    boundary = read_boundary(tmp_path / "b.json", CRS)
    points = np.array([[499_950.0, 5_300_000], [500_050, 5_300_000], [500_150, 5_300_000], [500_250, 5_300_000]])
    assert boundary.contains(points).tolist() == [True, True, True, False]
    assert boundary.area.area == pytest.approx(200 * 300, rel=1e-3)


def test_a_hole_of_one_polygon_leaves_another_whole(tmp_path: Path) -> None:
    ring, hole = lonlat(square(500_000, 5_300_000, 100)), lonlat(square(500_000, 5_300_000, 50))
    parts = [[ring, hole], [lonlat(square(500_000, 5_300_000, 20))]]
    boundary = read_boundary(write(tmp_path / "b.json", {"type": "MultiPolygon", "coordinates": parts}), CRS)
    points = np.array([[500_000.0, 5_300_000], [500_035, 5_300_000], [500_075, 5_300_000]])
    assert boundary.contains(points).tolist() == [True, False, True]


def test_a_bow_tie_keeps_both_its_wings(tmp_path: Path) -> None:
    x, y = 500_000, 5_300_000
    bow = lonlat([(x - 100, y - 100), (x + 100, y + 100), (x + 100, y - 100), (x - 100, y + 100)])
    boundary = read_boundary(write(tmp_path / "b.json", {"type": "Polygon", "coordinates": [bow]}), CRS)
    assert boundary.contains(np.array([[x - 80.0, y], [x + 80, y], [x, y + 80]])).tolist() == [True, True, False]


def shot(lat_deg: float, lon_deg: float) -> Shot:
    return Shot("a.jpg", Path("a.jpg"), 4000, 3000, "c", 0.8, 0.05, "guess", gps=GpsFix(lat_deg, lon_deg, None))


def test_a_boundary_of_another_place_is_refused(tmp_path: Path) -> None:
    ring = lonlat(square(500_000, 5_300_000, 100))
    file = write(tmp_path / "b.json", {"type": "Polygon", "coordinates": [ring]})
    lon, lat = ring[0]
    require_boundary_near(file, [shot(lat + 0.01, lon)])
    require_boundary_near(file, [])
    with pytest.raises(InputError, match="lies elsewhere"):
        require_boundary_near(file, [shot(lon, lat)])  # exchanged
    with pytest.raises(InputError, match="lies elsewhere"):
        require_boundary_near(file, [shot(lat + 1.0, lon)])


def test_edges_are_where_they_were_drawn(tmp_path: Path) -> None:
    ring = lonlat(square(520_000, 5_300_000, 2_000))
    boundary = read_boundary(write(tmp_path / "b.json", {"type": "Polygon", "coordinates": [ring]}), CRS)
    corners = shapely.get_coordinates(boundary.area)
    np.testing.assert_allclose(corners.min(axis=0), [518_000, 5_298_000], atol=0.5)  # edges straight in degrees
    assert np.abs(corners - [518_000, 5_298_000]).sum(axis=1).min() < 2e-3


def test_clipped_tiles_keep_their_fields_together() -> None:
    x = np.arange(10.0)
    tile = CloudTile(
        np.stack([x, x * 0, x], axis=-1),
        np.tile(np.uint8(x)[:, None], 3),
        np.float32(x),
        np.int32(x),
        np.int32(x),
        np.int32(x),
    )
    boundary = Boundary(shapely.box(2.5, -1, 6.5, 1))
    (kept,) = clipped([tile, tile.only(x < 2)], boundary)
    for name in ("confidence", "source", "batch", "views"):
        assert getattr(kept, name).tolist() == [3, 4, 5, 6]
    assert kept.points[:, 2].tolist() == [3, 4, 5, 6]
    assert kept.rgb[:, 0].tolist() == [3, 4, 5, 6]


def test_share_of_a_circle_inside() -> None:
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    points = np.random.default_rng(0).uniform(-1, 1, (20_000, 2))
    inside = in_ring(points, np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    assert inside.mean() == pytest.approx(np.pi / 4, abs=0.01)
    assert (inside == (np.linalg.norm(points, axis=1) < 1.0)).mean() > 0.999


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is no GeoJSON"),
        ("[" * 100_000, "is no GeoJSON"),
        ('{"type": "GeometryCollection", "geometries": [' * 500 + "]}" * 500, "is no GeoJSON|holds no polygon"),
        ('{"type": "Polygon", "coordinates": [[[NaN, 1], [2, 1], [2, 2], [1, 1]]]}', "not finite"),
        (
            '{"type": "Polygon", "crs": {"type": "name", "properties": {"name": "EPSG:3857"}}, '
            '"coordinates": [[[1, 1], [2, 1], [2, 2], [1, 1]]]}',
            "EPSG:3857",
        ),
        ('{"type": "Point", "coordinates": [1, 2]}', "holds no polygon"),
        ('{"type": "Polygon", "coordinates": [[[5e5, 5e6], [6e5, 5e6], [6e5, 6e6], [5e5, 5e6]]]}', "not in longitude"),
        ('{"type": "Polygon", "coordinates": [[["a", 5e6], [6e5, 5e6], [6e5, 6e6], [5e5, 5e6]]]}', "is no GeoJSON"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "b.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_boundary(tmp_path / "b.json", CRS)
