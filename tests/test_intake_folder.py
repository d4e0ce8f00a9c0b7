from __future__ import annotations

import shutil
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from onthefly3r.errors import InputError, PhotographError
from onthefly3r.intake.folder import read_photographs
from onthefly3r.intake.images import load_working_image
from onthefly3r.intake.metadata import read_shot
from onthefly3r.options import IntakeOptions

EXIF_IFD, GPS_IFD = 0x8769, 0x8825
DATE, SUBSECOND, FOCAL, ORIENTATION = 0x9003, 0x9291, 0x920A, 0x0112
TIME = "2024:05:01 10:00:{:02d}"


def picture(seed: int, width: int = 320, height: int = 240) -> Image.Image:
    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)


def write(path: Path, seed: int, date: str | None = None, subsecond: str | None = None, **options: Any) -> Path:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "DJI", "FC300S"
    details = exif.get_ifd(EXIF_IFD)
    details[FOCAL] = 3.61
    if date:
        details[DATE] = date
    if subsecond:
        details[SUBSECOND] = subsecond
    exif.get_ifd(GPS_IFD).update({1: "N", 2: (47.0, 30.0, float(seed)), 3: "E", 4: (8.0, 0.0, 0.0), 5: 0, 6: 500.0})
    path.parent.mkdir(parents=True, exist_ok=True)
    picture(seed).save(path, exif=exif, **options)
    return path


def names(folder: Path, **options: Any) -> list[str]:
    return [shot.name for shot in read_photographs(folder, IntakeOptions(**options))[0]]


def test_capture_order_by_time_then_subsecond_then_name(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", 1, TIME.format(9))
    write(tmp_path / "b.jpg", 2, TIME.format(3), "75")
    write(tmp_path / "c.jpg", 3, TIME.format(3), "5")
    write(tmp_path / "d.jpg", 4, TIME.format(3), "5")
    write(tmp_path / "0 no time.jpg", 5)
    assert names(tmp_path) == ["c.jpg", "d.jpg", "b.jpg", "a.jpg", "0 no time.jpg"]
    assert names(tmp_path, limit=2) == ["c.jpg", "d.jpg"]


def test_shuffling_is_repeatable_and_loses_nothing(tmp_path: Path) -> None:
    for i in range(8):
        write(tmp_path / f"{i}.jpg", i, TIME.format(i))
    plain, shuffled = names(tmp_path), names(tmp_path, shuffle_seed=3)
    assert shuffled == names(tmp_path, shuffle_seed=3)
    assert shuffled != plain
    assert sorted(shuffled) == plain
    assert sorted(names(tmp_path, shuffle_seed=3, limit=4)) == plain[:4]


def test_sub_folders_unicode_spaces_suffixes_and_same_names(tmp_path: Path) -> None:
    write(tmp_path / "flight 1" / "DJI_0001.JPG", 1)
    write(tmp_path / "Überflug 二" / "DJI_0001.JPG", 2)
    write(tmp_path / "x.Jpeg", 3)
    write(tmp_path / "y.TIF", 4)
    write(tmp_path / "z.png", 5)
    write(tmp_path / ".hidden" / "h.jpg", 6)
    (tmp_path / "notes.txt").write_text("no photograph")
    assert names(tmp_path) == ["flight 1/DJI_0001.JPG", "x.Jpeg", "y.TIF", "z.png", "Überflug 二/DJI_0001.JPG"]
    assert names(tmp_path, recursive=False) == ["x.Jpeg", "y.TIF", "z.png"]


def test_every_bad_file_is_named_and_none_stops_the_run(tmp_path: Path) -> None:
    good = write(tmp_path / "good.jpg", 1)
    shutil.copy(good, tmp_path / "later copy.jpg")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("hello")
    (tmp_path / "half header.jpg").write_bytes(good.read_bytes()[:10])
    picture(2, 150, 300).save(tmp_path / "tiny.jpg")
    Image.fromarray(np.zeros((240, 320), np.float32)).save(tmp_path / "float.tif")
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / "dangling.jpg").symlink_to(tmp_path / "nowhere.jpg")
    shots, refused = read_photographs(tmp_path, IntakeOptions())
    assert [shot.name for shot in shots] == ["good.jpg"]
    reasons = {photograph.name: photograph.reason for photograph in refused}
    assert set(reasons) == {
        "dangling.jpg", "empty.jpg", "float.tif", "half header.jpg", "later copy.jpg", "text.jpg", "tiny.jpg",
    }  # fmt: skip
    assert reasons["later copy.jpg"] == "the same file as good.jpg"
    assert "empty" in reasons["empty.jpg"]
    assert "below 200 px" in reasons["tiny.jpg"]


def test_duplicates_keep_the_first_name(tmp_path: Path) -> None:
    shutil.copy(write(tmp_path / "b.jpg", 1), tmp_path / "a.jpg")
    assert names(tmp_path) == ["a.jpg"]


def test_folder_errors_say_how_to_mend(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_photographs(tmp_path / "nowhere", IntakeOptions())
    with pytest.raises(InputError, match="no JPEG, PNG or TIFF"):
        read_photographs(tmp_path, IntakeOptions())


def test_too_many_pixels_are_refused_before_decoding(tmp_path: Path) -> None:
    # A PNG header that promises 30000 x 20000 pixels, with no data behind it.
    header = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + (30000).to_bytes(4, "big") + (20000).to_bytes(4, "big")
    chunk = header + b"\x08\x02\0\0\0"
    data = b"\0\0\0\0IDAT" + zlib.crc32(b"IDAT").to_bytes(4, "big")
    (tmp_path / "bomb.png").write_bytes(chunk + zlib.crc32(chunk[12:]).to_bytes(4, "big") + data)
    with pytest.raises(PhotographError, match="400 megapixels"):
        read_shot(tmp_path / "bomb.png", "bomb.png", IntakeOptions())


def test_damaged_exif_is_a_warning(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", 1, TIME.format(1))
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    start = data.index(b"Exif\0\0") + 6
    for offset in range(start, start + 60, 3):
        broken = bytearray(data)
        broken[offset : offset + 4] = b"\xff\xff\xff\x7f"
        (tmp_path / "a.jpg").write_bytes(broken)
        shot = read_shot(tmp_path / "a.jpg", "a.jpg", IntakeOptions())
        assert (shot.width_px, shot.height_px) in ((320, 240), (240, 320))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_images_are_upright(tmp_path: Path, orientation: int, suffix: str) -> None:
    upright = Image.new("RGB", (300, 240), (0, 0, 0))
    upright.paste((255, 0, 0), (0, 0, 100, 80))  # red in the upper left corner
    turned = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # inverse transpositions, PIL.Image.Transpose values
    stored = upright.transpose(Image.Transpose(turned[orientation])) if orientation > 1 else upright
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    path = tmp_path / f"turned{suffix}"
    stored.save(path, exif=exif)
    shot = read_shot(path, path.name, IntakeOptions())
    assert (shot.width_px, shot.height_px) == (300, 240)
    working = load_working_image(shot, 150)
    assert working.rgb.shape == (120, 150, 3)
    assert working.rgb[10, 10, 0] > 200
    assert working.rgb[[10, 110, 110], [140, 10, 140], 0].max() < 50


@pytest.mark.parametrize("size", [(1000, 750), (1001, 753), (640, 427)])
@pytest.mark.parametrize("working_px", [5000, 1000, 501, 250, 99])
def test_pixel_map_keeps_features_in_place(tmp_path: Path, size: tuple[int, int], working_px: int) -> None:
    """A bright disc's centre of gravity lands where the pixel map says, within 0.15 working pixels."""
    width, height = size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    centre = np.array([0.87 * width, 0.83 * height])
    disc = 255.0 / (1.0 + np.exp((np.hypot(u - centre[0], v - centre[1]) - 40.0) / 2.0))
    path = tmp_path / "disc.jpg"
    Image.fromarray(disc.astype(np.uint8)).convert("RGB").save(path, quality=95)
    working = load_working_image(read_shot(path, path.name, IntakeOptions()), working_px)
    assert max(working.rgb.shape[:2]) == min(working_px, width)
    weight = np.where(working.rgb[..., 0] > 30, working.rgb[..., 0].astype(float), 0.0)
    rows, columns = np.indices(weight.shape)
    found = np.array([(weight * (columns + 0.5)).sum(), (weight * (rows + 0.5)).sum()]) / weight.sum()
    assert np.abs(found - working.working_from_photo.apply(centre)).max() < 0.15


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "RGBA", "LA", "I;16"])
def test_other_pixel_types_become_rgb(tmp_path: Path, mode: str) -> None:
    grey = np.linspace(0, 255, 320 * 240).reshape(240, 320).astype(np.uint8)
    if mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
    else:
        image = Image.fromarray(grey).convert("RGB").convert(mode)
    path = tmp_path / ("a.tif" if mode in ("CMYK", "I;16") else "a.png")
    image.save(path)
    rgb = load_working_image(read_shot(path, path.name, IntakeOptions()), 1000).rgb
    assert rgb.shape == (240, 320, 3)
    assert rgb[:20].mean() < 30
    assert rgb[-20:].mean() > 225


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_truncated_pixels_are_refused_when_loaded(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"a{suffix}", 1)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    shot = read_shot(path, path.name, IntakeOptions())
    with pytest.raises(PhotographError, match=r"a\.(jpg|png|tif): pixels cannot be decoded"):
        load_working_image(shot, 1000)


def test_a_jpeg_with_a_preview_appended_is_a_photograph(tmp_path: Path) -> None:
    picture(1, 800, 600).save(tmp_path / "m.jpg", format="MPO", save_all=True, append_images=[picture(2, 200, 150)])
    shot = read_shot(tmp_path / "m.jpg", "m.jpg", IntakeOptions())
    assert (shot.width_px, shot.height_px) == (800, 600)
    expected = np.asarray(picture(1, 400, 300), float)
    assert np.abs(load_working_image(shot, 400).rgb - expected).mean() < 6.0


def test_threads_see_the_same_pixels(tmp_path: Path) -> None:
    shots = [read_shot(write(tmp_path / f"{i}.jpg", i), f"{i}.jpg", IntakeOptions()) for i in range(8)]
    alone = [load_working_image(shot, 160).rgb for shot in shots]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda shot: load_working_image(shot, 160).rgb, shots))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))


def test_camera_key_and_time(tmp_path: Path) -> None:
    shot = read_shot(write(tmp_path / "a.jpg", 1, TIME.format(7), "25"), "a.jpg", IntakeOptions())
    assert shot.camera_key == "DJI FC300S 3.61 mm 320x240"
    assert shot.time_s == pytest.approx(1714557607.25)
    assert shot.gps is not None
    assert shot.gps.lat_deg == pytest.approx(47.5 + 1 / 3600)
    for nonsense in ("0000:00:00 00:00:00", "2024:13:01 10:00:00", "yesterday", "    "):
        assert read_shot(write(tmp_path / "b.jpg", 2, nonsense), "b.jpg", IntakeOptions()).time_s is None


@pytest.mark.photographs
@pytest.mark.parametrize(
    ("name", "count", "truth"),
    [("brighton_beach", 18, 0.594), ("sheffield_cross", 172, 0.594), ("caliterra", 75, 0.757), ("copr", 41, 1.331)],
)
def test_focal_prior_of_real_cameras_holds(photograph_sets: Path, name: str, count: int, truth: float) -> None:
    shots, refused = read_photographs(photograph_sets / name / "photos", IntakeOptions())
    assert (len(shots), refused) == (count, [])
    assert len({shot.camera_key for shot in shots}) == 1
    for shot in shots:
        assert abs(shot.focal_ratio / truth - 1.0) < 2.0 * shot.focal_ratio_sigma
        assert shot.focal_source != "guess"
    assert (shots[0].gps is None) == (name == "copr")
