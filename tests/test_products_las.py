from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from onthefly3r.errors import ReconstructionError
from onthefly3r.products.las import las_scale_m, write_cloud
from onthefly3r.records import CloudTile

WKT1 = pyproj.CRS("EPSG:32633+5773").to_wkt("WKT1_GDAL")


def tile(seed: int, n: int = 2_000) -> CloudTile:
    rng = np.random.default_rng(seed)
    return CloudTile(
        points=np.array([433_210.0 + 50 * seed, 5_412_345.0, 287.0]) + rng.uniform(0, 50, (n, 3)) * [1, 1, 0.1],
        rgb=rng.integers(0, 256, (n, 3)).astype(np.uint8),
        confidence=rng.uniform(0, 1, n).astype(np.float32),
        source=rng.integers(0, 400, n).astype(np.int32),
        batch=rng.integers(0, 90, n).astype(np.int32),
        views=rng.integers(1, 300, n).astype(np.int32),
    )


def tiles() -> Iterator[CloudTile]:
    yield from (tile(seed) for seed in range(3))


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
def test_reads_back_point_for_point(tmp_path: Path, name: str) -> None:
    summary = write_cloud(tmp_path / name, tiles(), WKT1, 0.001, "a note")
    read = laspy.read(tmp_path / name)
    wanted = list(tiles())
    points = np.concatenate([t.points for t in wanted])
    assert summary.points == len(read.points) == 6_000
    assert np.abs(read.xyz - points).max() <= 0.0005 + 1e-9
    assert np.array_equal(
        np.stack([read.red, read.green, read.blue], 1) // 257, np.concatenate([t.rgb for t in wanted])
    )
    assert (np.stack([read.red, read.green, read.blue], 1) % 257 == 0).all()
    assert np.array_equal(read.point_source_id, np.concatenate([t.source for t in wanted]) + 1)
    assert np.array_equal(read["batch"], np.concatenate([t.batch for t in wanted]))
    views = np.minimum(np.concatenate([t.views for t in wanted]), 255)
    assert np.array_equal(read["n_views"], views)
    assert np.array_equal(read.user_data, views)
    assert np.abs(read["confidence"] / 255 - np.concatenate([t.confidence for t in wanted])).max() < 0.5 / 255 + 1e-6
    assert (read.return_number == 1).all()
    assert (read.number_of_returns == 1).all()
    assert (read.classification == 0).all()
    assert summary.bounds == (*read.xyz.min(axis=0), *read.xyz.max(axis=0))


def test_mean_spacing_is_that_of_the_grid(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(300) * 0.25, np.arange(300) * 0.25)
    part = tile(0, x.size)
    grid = CloudTile(
        np.stack([x, y, 0 * x], -1).reshape(-1, 3), part.rgb, part.confidence, part.source, part.batch, part.views
    )
    summary = write_cloud(tmp_path / "c.las", iter([grid]), WKT1, 0.001)
    assert summary.mean_spacing_m == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
def test_header_bytes_follow_the_standard(tmp_path: Path, name: str) -> None:
    """Fields at the byte positions of ASPRS LAS 1.4 R15, table 3; no LAS library involved."""
    write_cloud(tmp_path / name, tiles(), WKT1, 0.001, "a note")
    data = (tmp_path / name).read_bytes()
    assert data[:4] == b"LASF"
    (encoding,) = struct.unpack_from("<H", data, 6)
    assert encoding & 0b10000  # WKT
    assert data[24:26] == bytes([1, 4])
    header_size, offset_to_points, n_vlrs = struct.unpack_from("<HII", data, 94)
    assert header_size == 375
    assert data[104] & 0x3F == 7  # the upper bits mark compression
    assert bool(data[104] & 0x80) == name.endswith("laz")
    assert struct.unpack_from("<H", data, 105) == (36 + 6,)
    assert struct.unpack_from("<6I", data, 107) == (0,) * 6  # legacy counts
    scale = np.array(struct.unpack_from("<3d", data, 131))
    offset = np.array(struct.unpack_from("<3d", data, 155))
    assert (scale == 0.001).all()
    assert (offset == np.round(offset)).all()
    max_x, min_x, max_y, min_y, max_z, min_z = struct.unpack_from("<6d", data, 179)
    points = np.concatenate([t.points for t in tiles()])
    stored = np.rint((points - offset) / scale) * scale + offset
    assert (min_x, min_y, min_z) == tuple(stored.min(axis=0))
    assert (max_x, max_y, max_z) == tuple(stored.max(axis=0))
    assert struct.unpack_from("<Q", data, 247) == (6_000,)
    assert struct.unpack_from("<2Q", data, 255) == (6_000, 0)  # return 1, return 2
    if name.endswith("las"):
        assert len(data) == offset_to_points + 6_000 * 42
        x, y, z = struct.unpack_from("<3i", data, offset_to_points)
        assert np.allclose(np.array([x, y, z]) * scale + offset, points[0], atol=0.00051)

    records = {}
    at = header_size
    for _ in range(n_vlrs):
        user, number, length = struct.unpack_from("<2x16sHH", data, at)
        records[user.rstrip(b"\0").decode(), number] = data[at + 54 : at + 54 + length]
        at += 54 + length
    crs = pyproj.CRS.from_wkt(records["LASF_Projection", 2112].rstrip(b"\0").decode())
    assert crs.to_epsg() is not None or [c.to_epsg() for c in crs.sub_crs_list] == [32633, 5773]
    assert records["LASF_Projection", 2112].startswith(b"COMPD_CS[")
    assert records["LASF_Spec", 3] == b"a note\0"


def test_the_name_of_a_folder_that_cannot_be_decoded_is_escaped(tmp_path: Path) -> None:
    write_cloud(tmp_path / "cloud.las", tiles(), None, 0.001, "flight \udcff")
    with laspy.open(tmp_path / "cloud.las") as reader:
        texts = [vlr.record_data for vlr in reader.header.vlrs if vlr.record_id == 3]
    assert texts == [b"flight \\udcff\0"]


def test_without_crs_a_local_one_is_written(tmp_path: Path) -> None:
    write_cloud(tmp_path / "cloud.laz", tiles(), None, 0.001)
    with laspy.open(tmp_path / "cloud.laz") as reader:
        crs = reader.header.parse_crs()
    assert crs.type_name == "Engineering CRS"
    assert not crs.is_projected


def test_more_images_than_16_bit_go_to_an_extra_dimension(tmp_path: Path) -> None:
    part = tile(0)
    part.source[:] = np.arange(2_000) + 70_000
    write_cloud(tmp_path / "cloud.laz", iter([part]), WKT1, 0.001, n_images=80_000)
    read = laspy.read(tmp_path / "cloud.laz")
    assert np.array_equal(read["image"], part.source + 1)
    assert (read.point_source_id == 0).all()


def test_points_tell_the_part_of_a_map_in_parts(tmp_path: Path) -> None:
    part_of = np.arange(400) % 3 + 1
    write_cloud(tmp_path / "cloud.laz", tiles(), WKT1, 0.001, part_of=part_of)
    read = laspy.read(tmp_path / "cloud.laz")
    assert np.array_equal(read["part"], part_of[np.concatenate([t.source for t in tiles()])])
    write_cloud(tmp_path / "whole.laz", tiles(), WKT1, 0.001)
    assert "part" not in laspy.read(tmp_path / "whole.laz").point_format.dimension_names


def test_an_empty_cloud_is_refused_and_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "cloud.laz").write_bytes(b"old")
    with pytest.raises(ReconstructionError, match="no points"):
        write_cloud(tmp_path / "cloud.laz", iter([tile(0, 0)]), WKT1, 0.001)
    assert (tmp_path / "cloud.laz").read_bytes() == b"old"


def test_a_failure_on_the_way_leaves_no_half_file(tmp_path: Path) -> None:
    def failing() -> Iterator[CloudTile]:
        yield tile(0)
        raise RuntimeError("disk gone")

    with pytest.raises(RuntimeError, match="disk gone"):
        write_cloud(tmp_path / "cloud.laz", failing(), WKT1, 0.001)
    assert list(tmp_path.iterdir()) == []


def test_coordinates_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    far = tile(0)
    far.points[5, 0] += 3e6
    with pytest.raises(ReconstructionError, match="spacing_m"):
        write_cloud(tmp_path / "cloud.laz", iter([far]), WKT1, 0.001)


@pytest.mark.parametrize(("spacing_m", "scale_m"), [(5.0, 1e-3), (0.05, 1e-3), (0.01, 1e-3), (0.004, 1e-4)])
def test_scale_is_a_tenth_of_the_spacing_or_finer(spacing_m: float, scale_m: float) -> None:
    assert las_scale_m(spacing_m) == pytest.approx(scale_m)
