from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate import clouds, las_file, surface
from onthefly3r.evaluate.clouds import CloudFile, open_cloud
from onthefly3r.evaluate.surface import ground_difference, surface_errors
from onthefly3r.geometry.transforms import Sim3, rotation_exp

ORIGIN = np.array([576_700.0, 5_188_150.0, 160.0])


def cloud(points: np.ndarray, chunk: int = 700) -> CloudFile:
    return CloudFile(Path("memory"), len(points), lambda: (points[k : k + chunk] for k in range(0, len(points), chunk)))


def grid(side: int = 40, step: float = 1.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(side) * step, np.arange(side) * step)
    return ORIGIN + np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


@given(shift=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-3, 3)))
@settings(deadline=None, max_examples=30)
def test_a_shifted_grid_is_as_far_as_its_shift(shift: tuple[float, float, float]) -> None:
    """Shifted by less than half a cell, each point stays nearest to its own."""
    errors = surface_errors(cloud(grid() + shift), cloud(grid()))
    distance = float(np.linalg.norm(shift))
    for value in (errors.accuracy, errors.completeness, errors.chamfer, errors.accuracy_median):
        assert value == pytest.approx(distance, abs=1e-6)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), chunk=st.sampled_from([1, 7, 50, 1000]))
def test_agrees_with_all_pairs(seed: int, chunk: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 10, (60, 3)), rng.normal(5, 10, (80, 3))
    errors = surface_errors(cloud(a, chunk), cloud(b, chunk))
    distance = cdist(a, b)
    assert errors.accuracy == pytest.approx(distance.min(axis=1).mean(), rel=1e-9)
    assert errors.completeness == pytest.approx(distance.min(axis=0).mean(), rel=1e-9)
    assert errors.completeness_median == pytest.approx(np.median(distance.min(axis=0)), rel=1e-9)
    assert errors.chamfer == pytest.approx((errors.accuracy + errors.completeness) / 2)


def test_far_and_near_parts_are_all_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """The coarse first bound is poor here, and the chunks lie apart, as tiles of a cloud do."""
    monkeypatch.setattr(surface, "COARSE_POINTS", 30)
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 50, (2, 3_000, 3))
    b = b[np.argsort(b[:, 0])]
    errors = surface_errors(cloud(a), cloud(b, 100))
    assert errors.accuracy == pytest.approx(cdist(a, b).min(axis=1).mean(), rel=1e-9)


def test_half_a_cloud_is_accurate_but_not_complete() -> None:
    whole = grid()
    errors = surface_errors(cloud(whole[: len(whole) // 2]), cloud(whole))
    assert errors.accuracy == 0.0
    assert errors.completeness == pytest.approx(np.arange(1, 21).sum() / 40, rel=1e-9)  # 20 rows 1..20 m off, 20 at 0


def test_the_result_is_moved_first_and_distances_are_in_the_unit_of_the_reference() -> None:
    move = Sim3(4.0, rotation_exp(np.array([0.3, -0.2, 1.0])), np.array([5.0, 6.0, 7.0]))
    there = Sim3(1.0, np.eye(3), np.array([0.0, 0.0, 0.25])).apply(move.apply(grid() - ORIGIN))
    errors = surface_errors(cloud(grid() - ORIGIN), cloud(there), move)
    assert errors.accuracy == pytest.approx(0.25, abs=1e-9)
    assert errors.completeness == pytest.approx(0.25, abs=1e-9)


def test_a_sample_of_a_large_cloud_gives_the_same_mean() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 30, (20_000, 3)), rng.uniform(0, 30, (20_000, 3))
    whole, sampled = surface_errors(cloud(a), cloud(b)), surface_errors(cloud(a), cloud(b), max_queries=4_000)
    assert sampled.accuracy == pytest.approx(whole.accuracy, rel=0.03)
    assert sampled.accuracy != whole.accuracy


def test_ground_difference_ignores_what_only_one_cloud_has() -> None:
    rng = np.random.default_rng(0)
    ground = ORIGIN + np.column_stack([rng.uniform(0, 50, (20_000, 2)), rng.normal(0, 0.05, 20_000)])
    trees = ORIGIN + np.column_stack([rng.uniform(0, 15, (3_000, 2)), rng.uniform(3, 8, 3_000)])
    elsewhere = ground[:500] + np.array([500.0, 0.0, 40.0])
    result = np.concatenate([ground + np.array([0.0, 0.0, 1.5]), trees, elsewhere])
    difference = ground_difference(cloud(result), cloud(ground), cell=1.0)
    assert difference.median == pytest.approx(1.5, abs=0.02)
    assert difference.nmad < 0.1
    assert 2_490 <= difference.n_cells <= 2_500  # eight points a cell: a few are empty


def test_clouds_that_do_not_overlap_are_refused() -> None:
    with pytest.raises(ReferenceFormatError, match="overlap"):
        ground_difference(cloud(grid()), cloud(grid() + 1000.0), cell=1.0)


def write_las(path: Path, points: np.ndarray) -> None:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), ORIGIN
    las = laspy.LasData(header)
    las.xyz = points
    las.write(path)


PLY_HEADER = """ply
format {form} 1.0
comment made by a test
element vertex {n}
property uchar red
property float x
property double y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""


def write_ply(path: Path, points: np.ndarray, form: str) -> None:
    header = PLY_HEADER.format(form=form, n=len(points)).encode()
    if form == "ascii":
        body = "".join(f"7 {x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()) + "3 0 1 2\n"
        path.write_bytes(header + body.encode())
        return
    order = "<" if "little" in form else ">"
    vertices = np.zeros(len(points), [("r", "u1"), ("x", order + "f4"), ("y", order + "f8"), ("z", order + "f4")])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    path.write_bytes(header + vertices.tobytes() + b"\3" + bytes(12))


@pytest.mark.parametrize("name", ["c.las", "c.laz", "ascii.ply", "binary_little_endian.ply", "binary_big_endian.ply"])
def test_cloud_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(clouds, "CHUNK_POINTS", 64)
    monkeypatch.setattr(las_file, "CHUNK_POINTS", 64)
    points = np.round(np.random.default_rng(0).uniform(0, 100, (150, 3)), 3) + np.floor(ORIGIN / 1e6) * 1e6
    if name.endswith("ply"):
        write_ply(tmp_path / name, points, Path(name).stem)
    else:
        write_las(tmp_path / name, points)
    cloud_file = open_cloud(tmp_path / name)
    for _ in range(2):  # can be read again
        chunks = list(cloud_file.chunks())
        assert [len(chunk) for chunk in chunks] == [64, 64, 22]
        assert np.abs(np.concatenate(chunks) - points).max() < 6e-4
    assert cloud_file.n_points == 150


def test_an_output_folder_names_its_cloud(tmp_path: Path) -> None:
    write_las(tmp_path / "cloud.laz", grid(3))
    assert open_cloud(tmp_path).path == tmp_path / "cloud.laz"


def test_trimesh_reads_the_same_from_ply(tmp_path: Path) -> None:
    """An independent writer: what trimesh exports is read back."""
    trimesh = pytest.importorskip("trimesh")
    points = grid(5) - ORIGIN
    for encoding in ("ascii", "binary"):
        file = tmp_path / f"{encoding}.ply"
        file.write_bytes(trimesh.exchange.ply.export_ply(trimesh.PointCloud(points), encoding=encoding))
        assert np.allclose(np.concatenate(list(open_cloud(file).chunks())), points)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("missing.las", None, "no such file"),
        ("c.xyz", b"1 2 3\n", "are read from"),
        ("c.las", b"LASFbut not really", "not a LAS"),
        ("c.ply", b"plain text\n", "not a PLY"),
        ("c.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n", "incomplete"),
        ("c.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n", "x, y and z"),
        ("c.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n", "line 4"),
        ("c.ply", PLY_HEADER.format(form="ascii", n=2).encode() + b"1 2 3 4\n1 2 x 4\n", "damaged"),
        ("c.ply", PLY_HEADER.format(form="binary_little_endian", n=2).encode() + b"1234", "ends before"),
        ("c.ply", PLY_HEADER.format(form="ascii", n=0).encode(), "no points"),
    ],
)
def test_what_is_wrong_with_a_cloud_is_said(tmp_path: Path, name: str, data: bytes | None, message: str) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(ReferenceFormatError, match=message):
        list(open_cloud(tmp_path / name).chunks())


def test_a_truncated_laz_is_told(tmp_path: Path) -> None:
    write_las(tmp_path / "c.laz", grid(200))
    data = (tmp_path / "c.laz").read_bytes()
    (tmp_path / "c.laz").write_bytes(data[: len(data) // 2])
    with pytest.raises(ReferenceFormatError, match=r"c\.laz"):
        list(open_cloud(tmp_path / "c.laz").chunks())


def test_folder_without_cloud(tmp_path: Path) -> None:
    with pytest.raises(ReferenceFormatError, match="holds no cloud"):
        open_cloud(tmp_path)


@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(junk=st.binary(max_size=300))
def test_junk_never_gives_another_exception(tmp_path: Path, junk: bytes) -> None:
    for name, start in (("j.ply", b"ply\n"), ("j.las", b"LASF"), ("j.laz", b"")):
        (tmp_path / name).write_bytes(start + junk)
        with pytest.raises(ReferenceFormatError):
            list(open_cloud(tmp_path / name).chunks())
