"""Files among the photographs that are odd, hostile, deep, changing or not photographs at all."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from onthefly3r.errors import InputError, PhotographError
from onthefly3r.files.regular import open_regular
from onthefly3r.intake import images as images_module
from onthefly3r.intake.deep import with_common_range
from onthefly3r.intake.folder import read_photographs
from onthefly3r.intake.images import load_working_image
from onthefly3r.intake.metadata import read_shot
from onthefly3r.intake.reading import read_flight, shot_warnings
from onthefly3r.intake.stamp import Patience
from onthefly3r.options import IntakeOptions, Options
from onthefly3r.records import Shot


def picture(seed: int, width: int = 320, height: int = 240) -> Image.Image:
    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)


def write(path: Path, seed: int = 0, details: dict[int, Any] | None = None, xmp: str = "", **main: Any) -> Path:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "DJI", "FC300S"
    for tag, value in main.items():
        exif[int(tag[1:], 16)] = value
    exif.get_ifd(0x8769).update({0x920A: 3.61, **(details or {})})
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 30.0, float(seed)), 3: "E", 4: (8.0, 0.0, 0.0), 5: 0, 6: 500.0})
    path.parent.mkdir(parents=True, exist_ok=True)
    picture(seed).save(path, exif=exif, xmp=xmp.encode())
    return path


def shot_of(path: Path) -> Shot:
    return read_shot(path, path.name, IntakeOptions())


def dji(**values: str) -> str:
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())
    return f'<x:xmpmeta><rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></x:xmpmeta>'


@pytest.mark.parametrize(
    "date", ["9999:12:31 23:59:61", "2024:02:31 10:00:00", "0000:00:00 00:00:00", "1066:10:14 09:00:00"]
)
def test_impossible_dates_are_no_times(tmp_path: Path, date: str) -> None:
    assert shot_of(write(tmp_path / "a.jpg", details={0x9003: date})).time_s is None


@pytest.mark.parametrize(
    ("details", "xmp"),
    [
        ({0xA405: 65535}, ""),
        ({0x920A: 4e9}, ""),
        ({0x9000: b"9" * 5000}, ""),
        ({0x9291: "9" * 5000, 0x9003: "2024:05:01 10:00:00"}, ""),
        ({0xA434: "x" * 5000}, ""),
        ({0xA404: 1e6}, ""),
        ({}, dji(RtkStdLon="1e-300", RtkStdLat="1e-300", RtkStdHgt="1e300", RtkFlag="1e300")),
        ({}, dji(AbsoluteAltitude="1e300", RelativeAltitude="-1e300")),
        ({}, dji(GimbalYawDegree="nan", GimbalPitchDegree="1e300", GimbalRollDegree="inf")),
    ],
    ids=["35 mm", "focal", "version", "sub-seconds", "lens", "zoom", "sigmas", "heights", "angles"],
)
def test_absurd_tags_leave_a_shot_that_can_be_used(tmp_path: Path, details: dict[int, Any], xmp: str) -> None:
    shot = shot_of(write(tmp_path / "a.jpg", details=details, xmp=xmp))
    assert 0.1 <= shot.focal_ratio <= 60.0
    assert len(shot.camera_key) < 400
    assert shot.gps is not None
    assert shot.gps.height_m in (None, 500.0)
    assert shot.gps.sigma_h_m is None and shot.gps.sigma_v_m is None and shot.gps.rtk is None
    assert shot.above_takeoff_m is None and shot.attitude is None


def test_an_unexpected_error_refuses_that_photograph_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.jpg", 1)
    write(tmp_path / "b.jpg", 2)
    from onthefly3r.intake import folder

    def odd(path: Path, name: str, options: IntakeOptions) -> Shot:
        if name == "a.jpg":
            raise OverflowError("a tag that nobody thought of")
        return read_shot(path, name, options)

    monkeypatch.setattr(folder, "read_shot", odd)
    shots, refused = read_photographs(tmp_path, IntakeOptions())
    assert [shot.name for shot in shots] == ["b.jpg"]
    assert [photograph.name for photograph in refused] == ["a.jpg"]
    assert "nobody thought of" in refused[0].reason


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    """A pipe that is named like a photograph would be waited for without end."""
    write(tmp_path / "good.jpg")
    os.mkfifo(tmp_path / "pipe.jpg")
    os.mkfifo(tmp_path / "pipe 2.jpg")
    (tmp_path / "zero.jpg").symlink_to("/dev/zero")
    start = time.monotonic()
    shots, refused = read_photographs(tmp_path, IntakeOptions())
    assert time.monotonic() - start < 20.0
    assert [shot.name for shot in shots] == ["good.jpg"]
    assert {photograph.name for photograph in refused} == {"pipe.jpg", "pipe 2.jpg", "zero.jpg"}
    assert all("regular" in photograph.reason for photograph in refused)


def test_the_memory_of_a_picture_is_reckoned_before_it_is_decoded(tmp_path: Path) -> None:
    """A small PNG of one colour that takes gigabytes decoded, and a progressive JPEG whose coefficients do."""
    Image.new("L", (20_000, 19_000)).save(tmp_path / "a.png", compress_level=1)
    assert (tmp_path / "a.png").stat().st_size < 4 << 20
    Image.MAX_IMAGE_PIXELS = None
    shot = shot_of(tmp_path / "a.png")  # 380 MB: fits
    assert shot.width_px == 20_000
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[25] = 6  # RGBA
    import zlib

    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    (tmp_path / "b.png").write_bytes(data)
    with pytest.raises(PhotographError, match=r"takes \d+ MiB, more than 768 MiB"):
        shot_of(tmp_path / "b.png")


def test_forged_directories_do_not_read_gigabytes(tmp_path: Path) -> None:
    """A TIFF with a hole of 3 GB, and a tag that says it is that long."""
    stream = io.BytesIO()
    picture(1).save(stream, "TIFF")
    data = bytearray(stream.getvalue())
    start = int.from_bytes(data[4:8], "little")
    entry = start + 2 + 12 * (int.from_bytes(data[start : start + 2], "little") - 1)
    data[entry + 2 : entry + 12] = (7).to_bytes(2, "little") + (3 << 30).to_bytes(4, "little") + b"\0\0\0\x01"
    path = tmp_path / "hole.tif"
    path.write_bytes(data)
    os.truncate(path, 4 << 30)
    begin = time.process_time()
    with contextlib.suppress(PhotographError):  # the tag alone is left out where Pillow can do without it
        load_working_image(shot_of(path), 200)
    assert time.process_time() - begin < 2.0
    with open_regular(path, 1 << 20) as reader, pytest.raises(OSError, match="more is read"):
        reader.read()


@pytest.mark.parametrize(
    ("name", "head", "said"),
    [
        ("a.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC"),
        ("a.jpg", b"\0\0\0\x18ftypmp42\0\0\0\0isommp42", "video.*ffmpeg"),
        ("a.webp", b"RIFF\0\0\0\0WEBPVP8 ", "WebP.*convert"),
        ("a.jpg", b"GIF89a", "GIF.*convert"),
        ("a.nef", b"MM\0*\0\0\0\x08" + b"\0" * 60, "cannot be opened"),
        ("a.cr3", b"\0\0\0\x18ftypcrx \0\0\0\x01crx isom", "Canon raw.*convert"),
        ("a.dng", b"II*\0\x08\0\0\0\x01\0\x12\xc6\x01\0\x04\0\0\0\x01\x04\0\0", "DNG"),
    ],
)
def test_other_kinds_are_recognised_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, head: bytes, said: str
) -> None:
    from onthefly3r.intake import opening

    monkeypatch.setattr(opening, "can_read", lambda kind: False)
    (tmp_path / name).write_bytes(head + b"\0" * 200)
    _, refused = read_photographs(tmp_path, IntakeOptions())
    assert [photograph.name for photograph in refused] == [name]
    import re

    assert re.search(said, refused[0].reason)


def test_heic_is_read_where_the_extra_is_installed(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Apple", 6
    picture(3, 640, 480).save(tmp_path / "a.heic", exif=exif, quality=90)
    shot = shot_of(tmp_path / "a.heic")
    loaded = load_working_image(shot, 320)
    assert loaded.rgb.shape[:2] == (
        round(shot.height_px * 320 / max(shot.width_px, shot.height_px)),
        round(shot.width_px * 320 / max(shot.width_px, shot.height_px)),
    )
    assert shot.camera_key.startswith("Apple")


def test_panoramas_are_refused_with_what_to_do(tmp_path: Path) -> None:
    xmp = '<rdf:Description GPano:ProjectionType="equirectangular"/>'
    with pytest.raises(PhotographError, match=r"panorama \(equirectangular.*single photographs"):
        shot_of(write(tmp_path / "a.jpg", xmp=xmp))


def test_videos_pairs_and_tables_beside_the_photographs_are_told(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", 1)
    write(tmp_path / "b.jpg", 2)
    (tmp_path / "a.dng").write_bytes(b"II*\0")
    (tmp_path / "c.mp4").write_bytes(b"\0")
    (tmp_path / "Flight_Timestamp.MRK").write_text("1")
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.jpg 8 47.5 500\n")
    (tmp_path / "notes.txt").write_text("nothing")
    flight = read_flight(tmp_path, Options())
    assert [shot.name for shot in flight.shots] == ["a.jpg", "b.jpg"]
    assert flight.refused == ()
    text = "\n".join(flight.warnings)
    assert "geo.txt beside the photographs lists positions of 1 of 2" in text and "--positions" in text
    assert "1 videos such as c.mp4" in text
    assert "1 raw or HEIC files were left out" in text
    assert "Flight_Timestamp.MRK" in text
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "c.mp4").write_bytes(b"\0")
    with pytest.raises(InputError, match=r"1 videos such as c.mp4.*ffmpeg"):
        read_photographs(tmp_path / "videos", IntakeOptions())


def test_warnings_of_photographs_are_told_once_with_their_number(tmp_path: Path) -> None:
    shot = shot_of(write(tmp_path / "a.jpg"))
    shots = [replace(shot, name=f"{i}.jpg", warnings=(f"a height of {i}e300 m is not possible",)) for i in range(3)]
    told = shot_warnings([*shots, replace(shot, name="x.jpg", warnings=("GPSLatitudeRef is missing",))])
    assert told == [
        "3 of 4 photographs: a height of 0e300 m is not possible",
        "x.jpg: GPSLatitudeRef is missing",
    ]


@pytest.mark.parametrize("kind", ["grey", "32-bit", "colour"])
def test_deep_photographs_are_stretched_alike_over_the_flight(tmp_path: Path, kind: str) -> None:
    """Values that use a fortieth of 16 bits keep their levels; the same value is the same grey in all photographs."""
    rng = np.random.default_rng(0)
    base = np.kron(rng.integers(28_000, 29_600, (24, 32)), np.ones((10, 10), int))
    for k in range(3):
        values = base[:, :300] + 40 * k
        if kind == "colour":
            import cv2

            cv2.imwrite(str(tmp_path / f"{k}.tif"), np.repeat(values[..., None], 3, axis=2).astype(np.uint16))
        else:
            dtype = np.uint16 if kind == "grey" else np.int32
            Image.fromarray(values.astype(dtype)).save(tmp_path / f"{k}.tif")
    shots, refused = read_photographs(tmp_path, IntakeOptions())
    assert refused == [] and all(shot.deep for shot in shots)
    assert len({shot.value_range for shot in shots}) == 1
    first, last = (load_working_image(shot, 1000).rgb for shot in (shots[0], shots[2]))
    assert len(np.unique(first)) > 150
    assert 5 < float(np.mean(last.astype(int) - first)) < 20
    (again,) = with_common_range([shot_of(tmp_path / "0.tif")], known=shots)
    assert again.value_range == shots[0].value_range


def test_a_photograph_that_is_being_written_is_waited_for_and_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg")
    shot = shot_of(path)
    data = path.read_bytes()
    path.unlink()
    timer = threading.Timer(0.3, lambda: path.write_bytes(data))
    timer.start()
    told: list[str] = []
    loaded = load_working_image(shot, 320, told.append, Patience(30.0))
    timer.join()
    assert loaded.rgb.shape == (240, 320, 3)
    assert any("waited for" in text for text in told)
    assert any("written anew" in text for text in told)


def test_a_photograph_that_was_replaced_is_never_mixed_in(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", 1)
    shot = shot_of(path)
    write(path, 2)
    with pytest.raises(PhotographError, match="replaced by another photograph"):
        load_working_image(shot, 320, patience=Patience(1.0))
    path.unlink()
    with pytest.raises(PhotographError, match="cannot be read any more"):
        load_working_image(shot, 320, patience=Patience(0.2))


def test_out_of_memory_is_said_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object) -> Image.Image:
        raise MemoryError

    shot = shot_of(write(tmp_path / "a.jpg"))
    monkeypatch.setattr(images_module, "_to_rgb", full)
    with pytest.raises(PhotographError, match="not enough memory"):
        load_working_image(shot, 320, patience=Patience(0.0))


def negative(width: int = 320, height: int = 240) -> bytes:
    """A minimal DNG: one directory with 16-bit Bayer data, no thumbnail."""
    values = np.random.default_rng(0).integers(200, 4000, (height // 8, width // 8))
    data = np.kron(values, np.ones((8, 8))).astype("<u2").tobytes()
    one, matrix = struct.pack("<6I", 1, 1, 1, 1, 1, 1), struct.pack("<18i", *[1, 1, 0, 1, 0, 1, 0, 1, 1] * 2)
    shorts = {258: 16, 259: 1, 262: 32803, 274: 1, 277: 1, 284: 1, 50714: 0, 50717: 4095, 50778: 21}
    longs = {254: 0, 256: width, 257: height, 273: 0, 278: height, 279: len(data)}
    entries = {tag: (3, 1, struct.pack("<HH", value, 0)) for tag, value in shorts.items()}
    entries |= {tag: (4, 1, struct.pack("<I", value)) for tag, value in longs.items()}
    entries |= {33421: (3, 2, struct.pack("<HH", 2, 2)), 33422: (1, 4, b"\0\1\1\2"), 50706: (1, 4, b"\1\4\0\0")}
    entries |= {271: (2, 6, b"Maker\0"), 272: (2, 6, b"Model\0"), 50708: (2, 12, b"Maker Model\0")}
    entries |= {50721: (10, 9, matrix), 50728: (5, 3, one)}
    start = 8 + 2 + 12 * len(entries) + 4
    end = start + sum(len(value) for _, _, value in entries.values() if len(value) > 4)
    directory, further = b"", b""
    for tag, (kind, count, value) in sorted(entries.items()):
        if tag == 273:
            value = struct.pack("<I", end)
        place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", start + len(further))
        further += value if len(value) > 4 else b""
        directory += struct.pack("<HHI", tag, kind, count) + place
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + b"\0\0\0\0" + further + data


def test_dng_is_read_where_the_extra_is_installed(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    (tmp_path / "a.dng").write_bytes(negative())
    shot = shot_of(tmp_path / "a.dng")
    assert shot.camera_key == "Maker Model 320x240"
    for longest, size in ((200, (150, 200, 3)), (100, (75, 100, 3))):
        rgb = load_working_image(shot, longest).rgb
        assert rgb.shape == size and rgb.std() > 20.0
