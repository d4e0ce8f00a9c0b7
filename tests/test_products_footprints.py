"""Footprints against their closed form, and read back by pyshp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapefile
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.frames import enu_from_cam_rotation
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.products.footprints import footprint, with_overlap, write_footprints
from onthefly3r.records import PlacedCamera

CAMERA = Camera(1600, 900, 800.0, 800.0, 800.0, 450.0)


def placed(
    name: str, x: float, y: float, pitch_deg: float = -90.0, yaw_deg: float = 0.0, index: int = 0
) -> PlacedCamera:
    pose = Rigid3(enu_from_cam_rotation(yaw_deg, pitch_deg, 0.0), np.array([x, y, 140.0]))
    return PlacedCamera(index, name, CAMERA, pose, 0)


@given(st.floats(-180.0, 180.0))
def test_nadir_covers_width_times_height(yaw_deg: float) -> None:
    found = footprint(placed("a.jpg", 500_000.0, 5_000_000.0, yaw_deg=yaw_deg), ground_z_m=100.0)
    assert found is not None
    assert found.area_m2 == pytest.approx((1600 / 800 * 40.0) * (900 / 800 * 40.0), rel=1e-6)
    np.testing.assert_allclose(found.centre, [500_000.0, 5_000_000.0], atol=1e-6)
    assert found.gsd_m == pytest.approx(40.0 / 800.0)


def test_oblique_view_ends_before_the_horizon() -> None:
    found = footprint(placed("a.jpg", 0.0, 0.0, pitch_deg=-10.0), ground_z_m=100.0)
    assert found is not None
    assert np.linalg.norm(found.outline, axis=1).max() == pytest.approx(160.0)  # four flying heights


def test_ground_sampling_distance_of_an_oblique_view_is_that_of_the_slanted_ray() -> None:
    found = footprint(placed("a.jpg", 0.0, 0.0, pitch_deg=-50.0), ground_z_m=100.0)
    assert found is not None
    slant_m = float(np.hypot(40.0, np.linalg.norm(found.centre)))
    assert slant_m > 1.3 * 40.0
    assert found.gsd_m == pytest.approx(slant_m / 800.0)


@pytest.mark.parametrize(("pitch_deg", "ground_z_m"), [(-90.0, 150.0), (80.0, 100.0)])
def test_view_that_misses_the_ground_has_none(pitch_deg: float, ground_z_m: float) -> None:
    assert footprint(placed("a.jpg", 0.0, 0.0, pitch_deg), ground_z_m) is None


def test_names_that_a_shapefile_cannot_hold_are_shortened(tmp_path: Path) -> None:
    found = [footprint(placed(name, 0.0, 0.0), 100.0) for name in ("ü" * 300 + "/DJI_0001.JPG", "b\udcff.jpg")]
    write_footprints(tmp_path / "footprints.shp", [f for f in found if f], None)
    with shapefile.Reader(str(tmp_path / "footprints.shp")) as reader:
        long, undecodable = (record["image"] for record in reader.records())
    assert long.startswith("...ü")
    assert long.endswith("ü/DJI_0001.JPG")
    assert undecodable == "b?.jpg"


def test_overlap_counts_who_covers_the_centre(tmp_path: Path) -> None:
    cameras = [placed("a.jpg", 0.0, 0.0), placed("b.jpg", 30.0, 0.0), placed("ö.jpg", 500.0, 0.0, index=6)]
    found = with_overlap([f for f in (footprint(c, 100.0) for c in cameras) if f])
    assert [f.overlap for f in found] == [2, 2, 1]
    assert write_footprints(tmp_path / "footprints.shp", found, "EPSG:32633") == 3
    with shapefile.Reader(str(tmp_path / "footprints.shp")) as reader:
        assert reader.shapeType == shapefile.POLYGON
        records = [record.as_dict() for record in reader.records()]
        assert [len(shape.parts) for shape in reader.shapes()] == [1, 1, 1]
    assert [(r["image"], r["overlap"]) for r in records] == [("a.jpg", 2), ("b.jpg", 2), ("ö.jpg", 1)]
    assert [r["number"] for r in records] == [1, 1, 7]  # shot index + 1
    assert records[0]["area_m2"] == pytest.approx(3600.0)
    assert "UTM" in (tmp_path / "footprints.prj").read_text(encoding="utf-8")
