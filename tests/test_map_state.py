"""The map and its journal: what is committed is on disk, and reading it back gives the same map."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r.errors import InputError
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.map import store as store_module
from onthefly3r.map.journal import (
    rigid3_from_json,
    rigid3_to_json,
    shot_from_json,
    shot_to_json,
    sim3_from_json,
    sim3_to_json,
    submap_from_json,
    submap_to_json,
)
from onthefly3r.map.new_frame import colours_at_grid, new_frame
from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.records import Attitude, FrameEdge, GpsFix, NewFrame, Shot, Sighting, Submap, WorkingImage
from synthetic_models import HEIGHT_M, true_references, true_view

LENS = Camera(4000, 3000, 2801.5, 2799.25, 2010.0, 1490.0, (-0.08, 0.02, 4e-4, -3e-4))


def pose(seed: int) -> Sim3:
    rng = np.random.default_rng(seed)
    return Sim3(float(np.exp(rng.normal())), rotation_exp(rng.normal(size=3)), rng.normal(size=3))


def rigid(seed: int) -> Rigid3:
    return Rigid3(pose(seed).rotation, pose(seed).translation)


def shot(name: str = "été 1/ä.JPG", **values: Any) -> Shot:
    known = {"camera_key": "maker model", "focal_ratio": 0.7, "focal_ratio_sigma": 0.02, "focal_source": "guess"}
    return Shot(name, Path(name), 5600, 4200, **(known | values))


def image(index: int) -> WorkingImage:
    rgb = np.random.default_rng(index).integers(0, 256, (42, 56, 3), dtype=np.uint8)
    return WorkingImage(shot(), rgb, true_view(index).grid_from_photo)


def batch(number: int, indices: list[int], sightings: tuple[Sighting, ...] = ()) -> tuple[Submap, list[NewFrame]]:
    frames = [new_frame(i, number, true_view(i), image(i), 0.5, 300) for i in indices]
    return Submap(number, pose(number), tuple(new.frame for new in frames), sightings), frames


def sighting(frame: int, submap: int) -> Sighting:
    return Sighting(frame, submap, pose(10 * frame + submap), rigid(20 * frame + submap))


def filled(work: Path) -> MapState:
    state = MapState(Store(work))
    state.set_spacing(0.0123)
    submap, frames = batch(0, [4, 2, 9])
    state.commit(replace(submap, calibrations={"maker model": LENS}), frames)
    submap, frames = batch(1, [7, 1], (sighting(4, 1),))
    seen = FrameEdge(4, 7, rigid(3), 0.01, 0.2, "ref")
    state.commit(replace(submap, frame_edges=(seen,), calibrations={"maker model": replace(LENS, fx=1.0)}), frames)
    state.move_submaps({1: pose(77)}, {2: pose(78)}, {})
    return state


def assert_same(one: MapState, other: MapState) -> None:
    assert list(one.frames) == list(other.frames)
    assert one.spacing == other.spacing
    assert one.calibrations == other.calibrations
    assert one.frame_edges[0].kind == other.frame_edges[0].kind
    for index, frame in one.frames.items():
        again = other.frames[index]
        assert (frame.submap, frame.camera, frame.grid_from_photo, frame.depth) == (
            again.submap,
            again.camera,
            again.grid_from_photo,
            again.depth,
        )
        np.testing.assert_array_equal(one.map_from_cam(index).matrix(), other.map_from_cam(index).matrix())
        for name in ("pixels", "points", "confidence"):
            np.testing.assert_array_equal(getattr(one.reference(index), name), getattr(other.reference(index), name))
    for first, second in zip(one.sightings, other.sightings, strict=True):
        assert_same_sighting(first, second)


def assert_same_sighting(one: Sighting, other: Sighting) -> None:
    assert (one.frame, one.submap) == (other.frame, other.submap)
    np.testing.assert_array_equal(one.frame_from_submap.matrix(), other.frame_from_submap.matrix())
    np.testing.assert_array_equal(one.submap_from_cam.matrix(), other.submap_from_cam.matrix())


def test_a_journal_gives_the_same_map_again(tmp_path: Path) -> None:
    state = filled(tmp_path)
    again = MapState.load(Store(tmp_path))
    assert_same(state, again)
    assert again.calibrations == {"maker model": LENS}  # the first to see a camera says what it is
    assert again.next_submap() == 2 and again.last_accepted(3) == [9, 7, 1]
    again.commit(*batch(2, [5]))  # and it goes on
    assert_same(MapState.load(Store(tmp_path)), again)


def test_cameras_references_and_cloud_move_with_their_submap(tmp_path: Path) -> None:
    state = filled(tmp_path)
    before, unmoved = state.map_from_cam(7), state.map_from_cam(4)
    state.move_submaps({1: pose(5) @ pose(77)}, {}, {})
    np.testing.assert_allclose(state.map_from_cam(7).matrix(), pose(5).apply_to_pose(before).matrix(), atol=1e-12)
    assert state.submap_pose_of(7) is state.map_from_submap[1]
    np.testing.assert_array_equal(state.map_from_cam(4).matrix(), unmoved.matrix())


def test_a_settled_frame_leaves_its_submap_with_its_points(tmp_path: Path) -> None:
    state = filled(tmp_path)
    for map_ in (state, MapState.load(Store(tmp_path))):
        np.testing.assert_array_equal(map_.submap_pose_of(2).matrix(), pose(78).matrix())
        settled = pose(78).apply_to_pose(map_.frames[2].submap_from_cam)
        np.testing.assert_array_equal(map_.map_from_cam(2).matrix(), settled.matrix())
        assert map_.submap_pose_of(4) is map_.map_from_submap[0]


def test_the_papers_graph_moves_cameras_only(tmp_path: Path) -> None:
    state = filled(tmp_path)
    state.move_frames({7: rigid(8)})
    for map_ in (state, MapState.load(Store(tmp_path))):
        np.testing.assert_array_equal(map_.map_from_cam(7).matrix(), rigid(8).matrix())
        np.testing.assert_array_equal(map_.submap_pose_of(7).matrix(), pose(77).matrix())


def test_points_are_streamed_in_the_order_of_acceptance(tmp_path: Path) -> None:
    filled(tmp_path)
    store = Store(tmp_path)
    MapState.load(store)
    streamed = list(store.stream_points())
    assert [(p.index, p.submap) for p in streamed] == [(4, 0), (2, 0), (9, 0), (7, 1), (1, 1)]
    for points in streamed:
        np.testing.assert_array_equal(points.points, true_view(points.index).points.reshape(-1, 3))
        assert points.rgb.shape == points.points.shape and set(points.confidence) == {230}  # 0.9 of 255


def test_references_leave_memory_and_come_back_from_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "CACHED_REFERENCES", 2)
    state = filled(tmp_path)
    assert len(state._store._recent) == 2
    expected = true_references([4], 300)[4]
    np.testing.assert_array_equal(state.reference(4).points, expected.points)
    np.testing.assert_array_equal(state.reference(4).pixels, expected.pixels)
    assert len(state._store._recent) == 2


def test_a_batch_that_cannot_be_written_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = filled(tmp_path)
    monkeypatch.setattr(np, "savez", lambda *args, **named: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        state.commit(*batch(2, [5]))
    assert 5 not in state.frames and state.next_submap() == 2
    assert_same(state, MapState.load(Store(tmp_path)))


def test_a_chunk_without_its_journal_line_never_counted(tmp_path: Path) -> None:
    """Killed between the two."""
    state = filled(tmp_path)
    (tmp_path / "chunks" / "000002.npz").write_bytes((tmp_path / "chunks" / "000001.npz").read_bytes())
    assert_same(state, MapState.load(Store(tmp_path)))


@pytest.mark.parametrize("kept", [1, 20, -1])
def test_a_torn_last_line_never_counted(tmp_path: Path, kept: int) -> None:
    """Killed while the line was written."""
    state = filled(tmp_path)
    journal = tmp_path / "journal.jsonl"
    whole = journal.read_bytes()
    state.commit(*batch(2, [5]))
    journal.write_bytes(whole + journal.read_bytes()[len(whole) :][:kept])
    again = MapState.load(Store(tmp_path))
    assert 5 not in again.frames and list(again.frames) == [4, 2, 9, 7, 1]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{not json", "line 2: damaged"),
        ("[1, 2]", "line 2: damaged"),
        ('{"a": 1, "b": 2}', "line 2: damaged"),
        ('{"submap": {"frames": []}}', "'submap' is damaged"),
        ('{"settled": {"submaps": {"0": {"scale": "much"}}, "frames": {}}}', "'settled' is damaged"),
        ('{"settled": {"submaps": {}, "frames": [1]}}', "'settled' is damaged"),
        ('{"settled": [1]}', "'settled' is damaged"),
        ('{"spacing": null}', "'spacing' is damaged"),
    ],
)
def test_a_damaged_line_is_told_with_its_place(tmp_path: Path, line: str, said: str) -> None:
    filled(tmp_path)
    journal = tmp_path / "journal.jsonl"
    lines = journal.read_text(encoding="utf-8").splitlines()
    checked = f"{zlib.crc32(line.encode()):08x} {line}"
    journal.write_text("\n".join([lines[0], checked, *lines[1:]]) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=said):
        MapState.load(Store(tmp_path))


def test_any_flipped_byte_is_told_and_what_comes_before_is_there(tmp_path: Path) -> None:
    filled(tmp_path)
    journal = tmp_path / "journal.jsonl"
    whole = journal.read_bytes()
    lines = whole.splitlines(keepends=True)
    starts = np.cumsum([0, *map(len, lines)])
    for place in np.random.default_rng(0).integers(0, len(whole) - 1, 40):
        line = int(np.searchsorted(starts, place, side="right"))
        journal.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with pytest.raises(InputError, match=f"line {line}: damaged.*--partial"):
            MapState.load(Store(tmp_path))
        store = Store(tmp_path, partial=True)
        frames = list(MapState.load(store).frames)
        assert frames == [4, 2, 9, 7, 1][: len(frames)] and len(store.lost) == 1
        assert (len(frames) > 0) == (line > 3) and (len(frames) > 3) == (line > 4)


def test_a_journal_of_the_first_format_is_read(tmp_path: Path) -> None:
    state = filled(tmp_path)
    journal = tmp_path / "journal.jsonl"
    lines = journal.read_text(encoding="utf-8").splitlines()[1:]
    journal.write_text("".join(line.split(" ", 1)[1] + "\n" for line in lines), encoding="utf-8")
    assert_same(state, MapState.load(Store(tmp_path)))


@pytest.mark.parametrize("missing", [True, False])
def test_a_damaged_chunk_costs_the_points_of_its_photographs_only(tmp_path: Path, missing: bool) -> None:
    filled(tmp_path)
    chunk = tmp_path / "chunks" / "000000.npz"
    held = bytearray(chunk.read_bytes())
    held[len(held) // 2] ^= 1
    chunk.unlink() if missing else chunk.write_bytes(held)
    store = Store(tmp_path, partial=True)
    assert len(MapState.load(store).frames) == 5
    store.look_at_chunks()
    assert len(store.lost) == 1 and "3 photographs" in store.lost[0]
    assert [points.index for points in store.stream_points()] == [7, 1] and not len(store.reference(4).points)


def test_a_folder_without_a_journal_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no map"):
        MapState.load(Store(tmp_path))


def through_text(value: Any) -> Any:
    return json.loads(json.dumps(value))


def test_transforms_survive_json_to_the_last_digit() -> None:
    np.testing.assert_array_equal(sim3_from_json(through_text(sim3_to_json(pose(1)))).matrix(), pose(1).matrix())
    np.testing.assert_array_equal(rigid3_from_json(through_text(rigid3_to_json(rigid(2)))).matrix(), rigid(2).matrix())


def test_a_submap_survives_json() -> None:
    submap = replace(batch(3, [4, 5], (sighting(4, 3),))[0], calibrations={"k": LENS})
    again = submap_from_json(through_text(submap_to_json(submap)))
    assert again.calibrations == {"k": LENS} and again.number == 3
    assert [f.index for f in again.frames] == [4, 5]
    assert_same_sighting(again.sightings[0], submap.sightings[0])


@pytest.mark.parametrize("complete", [True, False])
def test_a_shot_survives_json(complete: bool) -> None:
    told = {
        "time_s": 1.5e9,
        "gps": GpsFix(48.0, 15.0, 301.5, "egm96", 0.02, 0.04, 50),
        "attitude": Attitude(10.0, -90.0, 0.5),
        "warnings": ("focal length guessed",),
    }
    one = shot(**(told if complete else {}))
    assert shot_from_json(through_text(shot_to_json(one))) == one


def test_a_new_frame_keeps_confident_points_with_the_colour_of_their_pixel() -> None:
    view, picture = true_view(3), image(3)
    confidence = view.confidence.copy()
    confidence[:, :30] = 0.2
    points = view.points.copy()
    points[0, 40] = np.nan
    new = new_frame(3, 8, replace(view, confidence=confidence, points=points), picture, 0.5, 300)
    assert (new.frame.index, new.frame.submap) == (3, 8)
    assert len(new.points) == 42 * 26 - 1 == len(new.rgb) == len(new.confidence)
    np.testing.assert_array_equal(new.rgb[-1], picture.rgb[-1, -1])
    np.testing.assert_array_equal(colours_at_grid(view, picture), picture.rgb)
    assert (new.reference.pixels[:, 0] >= 30).all()
    assert new.frame.depth == pytest.approx(HEIGHT_M, rel=0.1)  # over rolling ground


def test_a_frame_without_confident_points_has_no_depth() -> None:
    view = true_view(3)
    new = new_frame(3, 8, replace(view, confidence=np.zeros_like(view.confidence)), image(3), 0.5, 300)
    assert new.frame.depth == 0.0 and len(new.points) == 0
