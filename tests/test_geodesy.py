from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Geod, Proj, Transformer

from onthefly3r.errors import OptionError
from onthefly3r.geometry.geodesy import (
    VERTICAL_NAMES,
    EnuFrame,
    WorldFrame,
    projected_crs,
    transformation_accuracy_m,
    utm_crs_for,
    wkt1,
)
from onthefly3r.geometry.geoid import egm96_undulation_m

latitudes = st.floats(-79.0, 83.0)
longitudes = st.floats(-180.0, 180.0)


@pytest.mark.parametrize(
    ("lat", "lon", "undulation"),
    [  # test points that NGA publishes with the EGM96 interpolation program
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ],
)
def test_geoid_at_published_points(lat: float, lon: float, undulation: float) -> None:
    """Published values come from splines; bilinear interpolation is within 6 cm."""
    assert float(egm96_undulation_m(lat, lon)) == pytest.approx(undulation, abs=0.06)


def test_geoid_is_continuous_everywhere() -> None:
    for lon in (-180.0, 180.0, 0.0, 359.9999, 12.5):
        step = egm96_undulation_m(np.array([47.0, 47.0]), np.array([lon - 1e-6, lon + 1e-6]))
        assert abs(step[0] - step[1]) < 1e-4
    poles = egm96_undulation_m(np.array([90.0, 90.0, -90.0]), np.array([0.0, 123.0, 77.0]))
    assert poles == pytest.approx([13.606, 13.606, -29.534], abs=0.01)
    assert egm96_undulation_m(np.zeros((2, 3)), 5.0).shape == (2, 3)


@given(lat=latitudes, lon=longitudes, height=st.floats(-400.0, 9000.0), seed=st.integers(0, 99))
@settings(max_examples=50, deadline=None)
def test_enu_round_trip_and_axes(lat: float, lon: float, height: float, seed: int) -> None:
    frame = EnuFrame(lat, lon, height)
    points = np.random.default_rng(seed).uniform(-3000.0, 3000.0, (5, 3))
    assert np.abs(frame.from_geographic(frame.to_geographic(points)) - points).max() < 1e-5
    north, up = frame.to_geographic(np.array([[0.0, 100.0, 0.0], [0.0, 0.0, 100.0]]))
    azimuth, _, distance = Geod(ellps="WGS84").inv(lon, lat, north[1], north[0])
    assert abs(azimuth) < 0.01
    assert distance == pytest.approx(100.0 * (1.0 - height / 6.37e6), rel=1e-3)
    assert up == pytest.approx([lat, up[1], height + 100.0], abs=1e-6)


@given(lat=latitudes, lon=longitudes, vertical=st.sampled_from(sorted(VERTICAL_NAMES)), seed=st.integers(0, 99))
@settings(max_examples=50, deadline=None)
def test_world_round_trip(lat: float, lon: float, vertical: str, seed: int) -> None:
    world = WorldFrame(utm_crs_for(lat, lon), vertical, EnuFrame(lat, lon, 500.0))
    points = np.random.default_rng(seed).uniform(-2000.0, 2000.0, (5, 3))
    assert np.abs(world.to_enu(world.from_enu(points)) - points).max() < 1e-5


def test_world_against_a_direct_transformation() -> None:
    lat, lon, height = 47.5, 8.7, 612.0
    world = WorldFrame("EPSG:32632", "egm96", EnuFrame(lat, lon, height))
    east, north = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(lon, lat)
    undulation = float(egm96_undulation_m(lat, lon))
    assert 46.0 < undulation < 50.0
    assert world.from_enu(np.zeros((1, 3)))[0] == pytest.approx([east, north, height - undulation], abs=1e-6)
    ellipsoidal = WorldFrame("EPSG:32632", "ellipsoidal", world.enu).from_enu(np.zeros((1, 3)))[0]
    assert ellipsoidal[2] == pytest.approx(height, abs=1e-6)


@given(lat=latitudes, lon=longitudes)
@settings(max_examples=40, deadline=None)
def test_attitudes_turn_by_the_meridian_convergence(lat: float, lon: float) -> None:
    crs = utm_crs_for(lat, lon)
    rotation = WorldFrame(crs, "egm96", EnuFrame(lat, lon, 100.0)).rotation_world_from_enu()
    convergence = np.radians(Proj(crs).get_factors(lon, lat).meridian_convergence)
    # True north lies clockwise of grid north by minus the convergence; PROJ counts grid north east of true north.
    assert np.arctan2(rotation[0, 1], rotation[1, 1]) == pytest.approx(-convergence, abs=1e-6)
    assert rotation[2, 2] == pytest.approx(1.0, abs=1e-9)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_attitudes_far_from_the_origin_follow_the_local_vertical() -> None:
    world = WorldFrame("EPSG:32632", "ellipsoidal", EnuFrame(47.0, 9.0, 0.0))
    rotation = world.rotation_world_from_enu(np.array([10_000.0, 0.0, 0.0]))
    assert np.degrees(np.arccos(rotation[2, 2])) == pytest.approx(np.degrees(10_000.0 / 6.385e6), rel=0.01)


@pytest.mark.parametrize(
    ("lat", "lon", "epsg"),
    [
        (47.0, 8.0, 32632),
        (47.0, 12.0, 32633),  # a zone owns its western edge
        (0.0, 3.0, 32631),
        (-1e-9, 3.0, 32731),
        (-33.9, 151.2, 32756),
        (10.0, 180.0, 32601),
        (10.0, -180.0, 32601),
        (10.0, 179.999, 32660),
        (60.0, 5.0, 32632),  # Bergen
        (78.2, 15.6, 32633),  # Longyearbyen
        (78.9, 8.9, 32631),
        (85.0, 20.0, 5041),
        (84.0, 20.0, 32633),
        (-80.1, 20.0, 5042),
    ],
)
def test_utm_zones(lat: float, lon: float, epsg: int) -> None:
    assert utm_crs_for(lat, lon) == f"EPSG:{epsg}"


@given(lat=st.floats(-79.9, 71.9), lon=longitudes)
@settings(max_examples=60, deadline=None)
def test_utm_zone_is_used_where_epsg_says(lat: float, lon: float) -> None:
    if 56.0 <= lat < 64.0 and 3.0 <= lon < 6.0:
        return  # the Norwegian exception is no area of use in EPSG
    area = CRS.from_user_input(utm_crs_for(lat, lon)).area_of_use
    assert area is not None
    assert area.south - 1e-9 <= lat <= area.north + 1e-9
    assert area.west - 1e-9 <= (lon + 180.0) % 360.0 - 180.0 <= area.east + 1e-9


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:32755", "EPSG:2056", "EPSG:5041"])
@pytest.mark.parametrize(
    ("vertical", "epsg", "axes"),
    [("egm96", 5773, 3), ("egm2008", 3855, 3), ("ellipsoidal", None, 3), ("unknown", None, 2), ("relative", None, 2)],
)
def test_wkt1_is_read_back(crs: str, vertical: str, epsg: int | None, axes: int) -> None:
    text = wkt1(crs, vertical)
    read = CRS.from_wkt(text)
    assert text.startswith("COMPD_CS[" if axes == 3 else "PROJCS[")
    assert len(read.axis_info) == axes
    if epsg is not None:
        assert read.sub_crs_list[1].to_epsg() == epsg
        assert read.sub_crs_list[0].to_epsg() == int(crs.split(":")[1])
    if vertical == "ellipsoidal":
        assert "llipsoid" in read.axis_info[2].name


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("EPSG:4326", "not projected"),
        ("EPSG:2225", "not in metres"),
        ("EPSG:32633+5773", "vertical part"),
        ("EPSG:999999", "unknown to PROJ"),
        ("", "unknown to PROJ"),
    ],
)
def test_unusable_crs_is_refused_with_a_remedy(text: str, reason: str) -> None:
    with pytest.raises(OptionError, match=reason):
        projected_crs(text)


def test_accuracy_of_datum_shifts_is_stated() -> None:
    assert transformation_accuracy_m("EPSG:32633", 47.0, 15.0) == 0.0
    assert 0.5 <= transformation_accuracy_m("EPSG:27700", 52.0, -1.0) <= 10.0
