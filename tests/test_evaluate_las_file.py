"""LAS and LAZ files whose header lies: refused before memory is asked for, whatever was changed in them."""

from __future__ import annotations

import contextlib
import struct
import time
import tracemalloc
from pathlib import Path

import laspy
import numpy as np
import pytest

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate.las_file import open_las

POINTS = np.round(np.random.default_rng(0).uniform(0, 100, (500, 3)), 3) + np.array([500_000, 5_300_000, 100])


def write(path: Path, version: str = "1.4") -> Path:
    header = laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version)
    header.offsets, header.scales = np.floor(POINTS.min(axis=0)), np.full(3, 0.001)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = POINTS.T
    cloud.write(path)
    return path


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_what_an_independent_program_wrote_is_read(tmp_path: Path, name: str, version: str) -> None:
    las = open_las(write(tmp_path / name, version))
    assert las.n_points == len(POINTS)
    np.testing.assert_allclose(np.vstack(list(las.chunks())), POINTS, atol=1e-6)
    np.testing.assert_allclose(las.bounds, [POINTS.min(axis=0), POINTS.max(axis=0)], atol=1e-3)


def changed(path: Path, at: int, kind: str, value: int) -> Path:
    data = bytearray(path.read_bytes())
    struct.pack_into(kind, data, at, value)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("name", "at", "kind", "value"),
    [
        ("a.las", 247, "<Q", 2**40),  # number of points
        ("a.laz", 247, "<Q", 2**40),
        ("a.laz", 247, "<Q", 10**8),
        ("a.las", 96, "<I", 2**32 - 1),  # offset of the points
        ("a.las", 100, "<I", 2**32 - 1),  # number of records
        ("a.las", 94, "<H", 2**16 - 1),  # size of the header
        ("a.las", 105, "<H", 0),  # size of a point
        ("a.las", 243, "<I", 2**32 - 1),  # number of extended records
        ("a.las", 104, "<B", 0x80 | 6),  # said to be compressed
        ("a.las", 0, "<I", 0),
    ],
)
def test_a_header_that_contradicts_the_file_is_refused(
    tmp_path: Path, name: str, at: int, kind: str, value: int
) -> None:
    path = changed(write(tmp_path / name), at, kind, value)
    with pytest.raises(ReferenceFormatError, match=name):
        list(open_las(path).chunks())


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_damaged_files_end_in_our_own_error_in_little_time_and_memory(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(1)
    good = write(tmp_path / name).read_bytes()
    slowest_s = 0.0
    tracemalloc.start()
    for _ in range(300):
        data = bytearray(good[: rng.integers(1, len(good))] if rng.random() < 0.3 else good)
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(0, min(len(data), 700) if rng.random() < 0.8 else len(data)))
            data[at] = int(rng.integers(0, 256))
        (tmp_path / name).write_bytes(data)
        began = time.process_time()
        with contextlib.suppress(ReferenceFormatError):
            sum(len(chunk) for chunk in open_las(tmp_path / name).chunks())
        slowest_s = max(slowest_s, time.process_time() - began)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert slowest_s < 1.0
    assert peak < 2**30
