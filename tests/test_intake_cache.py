"""Each photograph is decoded once, however many subsets look at it."""

from __future__ import annotations

import shutil
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import PhotographError
from onthefly3r.geometry.camera import PixelMap
from onthefly3r.intake import cache
from onthefly3r.intake.cache import ImageCache
from onthefly3r.records import Shot, WorkingImage


class Decoder:
    """Stands in for the reading of photographs and counts it."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()

    def __call__(self, shot: Shot) -> WorkingImage:
        self.calls[shot.name] += 1
        time.sleep(0.01)
        number = int(shot.name)
        if number == 13:
            raise PhotographError(shot.name, "damaged")
        rgb = np.random.default_rng(number).integers(0, 255, (30 + number, 40, 3), np.uint8)
        return WorkingImage(shot, rgb, PixelMap(0.1, 0.2))


@pytest.fixture
def shots(monkeypatch: pytest.MonkeyPatch) -> dict[int, Shot]:
    monkeypatch.setattr(cache, "CACHED_IMAGES", 3)
    return {i: Shot(str(i), Path(f"{i}.jpg"), 400, 300, "camera", 0.7, 0.05, "guess") for i in range(12)}


def test_each_photograph_is_decoded_once(shots: dict[int, Shot], tmp_path: Path) -> None:
    decode = Decoder()
    images = ImageCache(shots, decode, tmp_path / "Bilder süd")
    first = {i: images[i] for i in shots}
    for i in [3, 0, 11, 0, 5, *reversed(range(12))]:
        again = images[i]
        assert np.array_equal(again.rgb, first[i].rgb)
        assert again.shot == shots[i] and again.working_from_photo == PixelMap(0.1, 0.2)
    assert set(decode.calls.values()) == {1} and len(decode.calls) == 12


def test_threads_that_ask_for_one_image_wait_for_each_other(shots: dict[int, Shot], tmp_path: Path) -> None:
    decode = Decoder()
    images = ImageCache(shots, decode, tmp_path)
    together = threading.Barrier(4)

    def ask(order: int) -> int:
        together.wait()
        return sum(int(images[i].rgb.sum()) for i in np.random.default_rng(order).permutation(12))

    with ThreadPoolExecutor(4) as pool:
        sums = set(pool.map(ask, range(4)))
    assert len(sums) == 1
    assert set(decode.calls.values()) == {1}


def test_what_is_gone_from_disk_is_decoded_again(shots: dict[int, Shot], tmp_path: Path) -> None:
    decode = Decoder()
    images = ImageCache(shots, decode, tmp_path / "features")
    first = {i: images[i] for i in shots}
    shutil.rmtree(tmp_path / "features")
    assert np.array_equal(images[0].rgb, first[0].rgb)
    assert decode.calls["0"] == 2


def test_files_of_an_earlier_run_and_a_full_disk_do_no_harm(shots: dict[int, Shot], tmp_path: Path) -> None:
    earlier = ImageCache(shots, Decoder(), tmp_path / "features")
    for i in shots:
        assert earlier[i].rgb.shape[0] == 30 + i
    other = {i: Shot(str(20 + i), Path("x.jpg"), 400, 300, "camera", 0.7, 0.05, "guess") for i in shots}
    images = ImageCache(other, Decoder(), tmp_path / "features")
    assert images[0].rgb.shape[0] == 50
    (tmp_path / "a file").write_text("where a folder should be")
    decode = Decoder()
    images = ImageCache(shots, decode, tmp_path / "a file" / "features")
    first = {i: images[i] for i in shots}
    assert np.array_equal(images[0].rgb, first[0].rgb) and decode.calls["0"] == 2


def test_a_damaged_photograph_is_told_each_time(shots: dict[int, Shot], tmp_path: Path) -> None:
    images = ImageCache({0: Shot("13", Path("x.jpg"), 400, 300, "camera", 0.7, 0.05, "guess")}, Decoder(), tmp_path)
    for _ in range(2):
        with pytest.raises(PhotographError, match="damaged"):
            images[0]
