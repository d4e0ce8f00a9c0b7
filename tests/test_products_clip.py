"""Cutting a cloud to GeoJSON polygons, against shapes whose area and place are known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest

from onthefly3r.errors import InputError
from onthefly3r.products.clip import Boundary, clipped, in_ring, read_boundary
from onthefly3r.records import CloudTile

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


def test_edges_are_where_they_were_drawn(tmp_path: Path) -> None:
    ring = lonlat(square(520_000, 5_300_000, 2_000))
    boundary = read_boundary(write(tmp_path / "b.json", {"type": "Polygon", "coordinates": [ring]}), CRS)
    corners = boundary.rings[0]
    np.testing.assert_allclose(corners.min(axis=0), [518_000, 5_298_000], atol=0.5)  # edges straight in degrees
    np.testing.assert_allclose(corners[0], [518_000, 5_298_000], atol=1e-3)


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
    boundary = Boundary((np.array([[2.5, -1], [6.5, -1], [6.5, 1], [2.5, 1.0]]),))
    (kept,) = clipped([tile, CloudTile(*(getattr(tile, n)[:2] for n in tile.__dataclass_fields__))], boundary)
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
        ('{"type": "Point", "coordinates": [1, 2]}', "holds no polygon"),
        ('{"type": "Polygon", "coordinates": [[[5e5, 5e6], [6e5, 5e6], [6e5, 6e6], [5e5, 5e6]]]}', "not in longitude"),
        ('{"type": "Polygon", "coordinates": [[["a", 5e6], [6e5, 5e6], [6e5, 6e6], [5e5, 5e6]]]}', "is no GeoJSON"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "b.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_boundary(tmp_path / "b.json", CRS)
