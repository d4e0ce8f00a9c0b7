"""Arrays that numpy wrote come back; a file that lies about its sizes is refused before memory is asked for."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import InputError
from onthefly3r.files.array_file import ArrayFile

ARRAYS = {
    "7/points": np.arange(12, dtype=np.float32).reshape(4, 3),
    "turned": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "empty": np.zeros((0, 3), np.uint8),
    "scalar": np.array(3.5),
}


def test_what_numpy_wrote_is_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **ARRAYS)
    with ArrayFile(tmp_path / "a.npz") as stored:
        for name, array in ARRAYS.items():
            assert name in stored
            np.testing.assert_array_equal(stored[name], array)
            assert stored[name].dtype == array.dtype
            assert stored[name].flags.writeable
        assert "nothing" not in stored
        with pytest.raises(InputError, match=r"a\.npz is missing or damaged"):
            stored["nothing"]


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


def write(path: Path, member: bytes, compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("a.npy", member)
    return path


def bomb() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.zeros(8_000_000))
    return stream.getvalue()


@pytest.mark.parametrize(
    ("member", "compression"),
    [
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}"), zipfile.ZIP_STORED),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}", bytes(8)), zipfile.ZIP_STORED),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"cos\nsystem\n."), zipfile.ZIP_STORED),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}", bytes(9)), zipfile.ZIP_STORED),
        (npy("{" * 100), zipfile.ZIP_STORED),
        (b"", zipfile.ZIP_STORED),
        (bomb(), zipfile.ZIP_DEFLATED),
    ],
)
def test_files_that_lie_are_refused(tmp_path: Path, member: bytes, compression: int) -> None:
    path = write(tmp_path / "a.npz", member, compression)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="damaged"), ArrayFile(path) as stored:
            stored["a"]
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_changed_bytes_end_in_our_own_error(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **ARRAYS)
    good = (tmp_path / "a.npz").read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(400):
        data = bytearray(good[: rng.integers(0, len(good))] if rng.random() < 0.3 else good)
        for at in rng.integers(0, len(data), 3) if data else ():
            data[at] = rng.integers(0, 256)
        (tmp_path / "a.npz").write_bytes(data)
        try:
            with ArrayFile(tmp_path / "a.npz") as stored:
                for name in ARRAYS:
                    stored[name]
        except InputError:
            refused += 1
    assert refused > 100
