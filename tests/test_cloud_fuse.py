from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from onthefly3r.cloud import fuse as fuse_module
from onthefly3r.cloud import spill
from onthefly3r.cloud.fuse import fuse
from onthefly3r.records import CloudTile

ORIGIN = np.array([576_700.0, 5_188_150.0, 160.0])


def batch(points: np.ndarray, source: int = 0, confidence: float = 0.8, rgb: tuple[int, int, int] = (10, 20, 30)):
    n = len(points)
    return CloudTile(
        points=np.asarray(points, float),
        rgb=np.tile(np.array(rgb, np.uint8), (n, 1)),
        confidence=np.full(n, confidence, np.float32),
        source=np.full(n, source, np.int32),
        batch=np.full(n, source // 5, np.int32),
        views=np.ones(n, np.int32),
    )


def joined(tiles: Iterable[CloudTile]) -> CloudTile:
    tiles = list(tiles)
    names = ("points", "rgb", "confidence", "source", "batch", "views")
    return CloudTile(*(np.concatenate([getattr(tile, name) for tile in tiles]) for name in names))


def ground(rng: np.random.Generator, n: int, side_m: float, noise_m: float = 0.0) -> np.ndarray:
    xy = rng.uniform(0, side_m, (n, 2))
    return ORIGIN + np.column_stack([xy, rng.normal(0, noise_m, n)])


def reference_fusion(
    batches: list[CloudTile], spacing_m: float
) -> dict[tuple[int, ...], tuple[np.ndarray, float, int]]:
    """The definition, voxel by voxel in plain Python."""
    voxels: dict[tuple[int, ...], list[tuple[np.ndarray, float, int]]] = {}
    for part in batches:
        for point, confidence, source in zip(part.points, part.confidence, part.source, strict=True):
            key = tuple(int(k) for k in np.floor(point / spacing_m))
            voxels.setdefault(key, []).append((point, float(confidence), int(source)))
    fused = {}
    for key, seen in voxels.items():
        weight = np.array([c for _, c, _ in seen])
        mean = weight @ np.array([p for p, _, _ in seen]) / weight.sum()
        n = len({source for _, _, source in seen})
        fused[key] = (mean, 1.0 - (1.0 - weight.mean()) ** n**0.5, n)
    return fused


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), spacing_m=st.sampled_from([0.3, 0.01, 2.0]))
def test_agrees_with_the_definition(tmp_path: Path, seed: int, spacing_m: float) -> None:
    rng = np.random.default_rng(seed)
    shift = rng.choice([1.0, -1.0], 3)  # the grid must work on both sides of zero
    batches = []
    for source in range(4):
        part = batch(shift * ground(rng, 150, 300 * spacing_m, spacing_m), source)
        batches.append(CloudTile(part.points, part.rgb, rng.uniform(0.1, 1.0, 150).astype(np.float32), *vars_of(part)))
    cloud = joined(fuse(batches, spacing_m, 0.0, tmp_path, stray_filter=False))
    expected = reference_fusion(batches, spacing_m)
    assert len(cloud.points) == len(expected)
    for point, confidence, views in zip(cloud.points, cloud.confidence, cloud.views, strict=True):
        mean, wanted, n = expected[tuple(int(k) for k in np.floor(point / spacing_m))]
        assert np.allclose(point, mean, atol=1e-6)
        assert confidence == pytest.approx(wanted, abs=1e-6)
        assert views == n


def vars_of(part: CloudTile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return part.source, part.batch, part.views


def test_strongest_observation_names_image_and_batch_and_colour_is_weighted(tmp_path: Path) -> None:
    at = ORIGIN[None] + 0.05
    seen = [batch(at, 3, 0.2, (0, 0, 0)), batch(at, 11, 0.9, (110, 220, 33)), batch(at, 12, 0.9, (110, 220, 33))]
    cloud = joined(fuse(seen, 0.1, 0.0, tmp_path, stray_filter=False))
    assert (cloud.source.tolist(), cloud.batch.tolist(), cloud.views.tolist()) == ([11], [2], [3])
    assert cloud.rgb.tolist() == [[99, 198, 30]]


def test_confidence_grows_with_agreeing_images_not_with_repeats_of_one(tmp_path: Path) -> None:
    at = ORIGIN[None] + 0.05

    def confidence(sources: list[int]) -> float:
        return float(joined(fuse([batch(at, s, 0.4) for s in sources], 0.1, 0.0, tmp_path, False)).confidence[0])

    assert confidence([1]) == pytest.approx(0.4, abs=1e-6)
    assert confidence([1, 1, 1]) == pytest.approx(0.4, abs=1e-6)
    assert confidence([1, 2]) == pytest.approx(1 - 0.6**2**0.5, abs=1e-6)
    assert confidence([1, 2, 3, 4]) == pytest.approx(1 - 0.6**2, abs=1e-6)


def test_points_below_the_least_confidence_are_dropped(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    assert len(joined(fuse([batch(ground(rng, 9, 5.0), 0, 0.7)], 1e-3, 0.7, tmp_path, False)).points) == 9
    weak, strong = ground(rng, 50, 5.0), ground(rng, 60, 5.0) + np.array([100.0, 0.0, 0.0])
    cloud = joined(fuse([batch(weak, 0, 0.3), batch(strong, 1, 0.7)], 1e-3, 0.5, tmp_path, False))
    assert len(cloud.points) == 60
    assert (cloud.confidence >= 0.5).all()


def test_unusable_points_are_left_out(tmp_path: Path) -> None:
    points = ground(np.random.default_rng(0), 40, 5.0)
    points[0, 2], points[1, 0], points[2] = np.nan, np.inf, 1e30
    part = batch(points)
    part.confidence[3] = 0.0
    assert len(joined(fuse([part], 1e-3, 0.0, tmp_path, False)).points) == 36


def test_stray_points_go_and_the_surface_stays(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    surface = ground(rng, 40_000, 10.0, noise_m=0.05)
    strays = ORIGIN + np.column_stack([rng.uniform(0, 10, (60, 2)), rng.uniform(3, 60, 60)])
    cloud = joined(fuse([batch(surface), batch(strays, 1)], 0.1, 0.0, tmp_path, stray_filter=True))
    above = cloud.points[:, 2] > ORIGIN[2] + 2.0
    everything = joined(fuse([batch(surface), batch(strays, 1)], 0.1, 0.0, tmp_path, stray_filter=False))
    assert above.sum() == 0
    assert len(cloud.points) >= 0.99 * (everything.points[:, 2] < ORIGIN[2] + 2.0).sum()


def test_a_voxel_finer_than_the_points_does_not_make_everything_stray(tmp_path: Path) -> None:
    column, row = np.meshgrid(np.arange(70), np.arange(70))
    pixels = np.stack([column, row, 0 * row], axis=-1).reshape(-1, 3) * 0.5  # point map with pixels of 0.5 m
    surface = ORIGIN + pixels + np.random.default_rng(4).normal(0, 0.1, pixels.shape)
    assert len(joined(fuse([batch(surface)], 0.1, 0.0, tmp_path, stray_filter=True)).points) > 0.95 * len(pixels)


@pytest.mark.parametrize(("tile_voxels", "square_points"), [(8, 2_000_000), (64, 500), (256, 1_000)])
def test_result_does_not_depend_on_tiles_quarters_and_buffers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tile_voxels: int, square_points: int
) -> None:
    rng = np.random.default_rng(5)
    batches = [batch(ground(rng, 3_000, 20.0, noise_m=0.3), source, 0.6) for source in range(4)]
    # Groups of three to seven above it, of which the stray filter drops some, at the borders too.
    places = np.column_stack([rng.uniform(0, 20, (600, 2)), rng.uniform(9, 200, 600)])
    groups = np.repeat(ORIGIN + places, rng.integers(3, 8, 600), axis=0)
    batches.append(batch(groups + rng.normal(0, 0.25, groups.shape), 4, 0.6))
    whole = joined(fuse(batches, 0.25, 0.5, tmp_path, stray_filter=True))
    monkeypatch.setattr(fuse_module, "TILE_VOXELS", tile_voxels)
    monkeypatch.setattr(fuse_module, "MAX_SQUARE_POINTS", square_points)
    monkeypatch.setattr(spill, "BUFFER_POINTS", 4_000)
    pieces = list(fuse(batches, 0.25, 0.5, tmp_path, stray_filter=True))
    cut = joined(pieces)
    assert len(pieces) > 4
    everything = joined(fuse(batches, 0.25, 0.5, tmp_path, stray_filter=False))
    assert 300 < len(everything.points) - len(whole.points) < 3_000
    assert len(cut.points) == len(whole.points)
    by_place = [np.lexsort(np.round(cloud.points, 6).T) for cloud in (whole, cut)]
    assert np.allclose(whole.points[by_place[0]], cut.points[by_place[1]], atol=1e-6)
    assert np.array_equal(whole.views[by_place[0]], cut.views[by_place[1]])


@pytest.mark.parametrize("threads", [1, 3])
def test_temporary_files_are_removed_also_when_cancelled(tmp_path: Path, threads: int) -> None:
    def stop(done: int, total: int) -> None:
        raise RuntimeError(f"{done} of {total}")

    points = ground(np.random.default_rng(0), 1_000, 50.0)
    with pytest.raises(RuntimeError, match="1 of 4"):
        list(fuse([batch(points - ORIGIN - [25.0, 25.0, 0.0])], 0.1, 0.0, tmp_path, False, stop, threads))
    assert list(tmp_path.iterdir()) == []


def test_same_cloud_in_the_same_order_whatever_the_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spill, "BUFFER_POINTS", 3_000)  # several files
    rng = np.random.default_rng(4)
    batches = [batch(ground(rng, 2_000, 90.0), source, 0.7) for source in range(5)]
    alone, together = (list(fuse(batches, 0.2, 0.0, tmp_path, True, threads=threads)) for threads in (1, 3))
    assert len(alone) == len(together) > 3
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one.points, other.points) and np.array_equal(one.confidence, other.confidence)


def test_files_of_a_killed_run_are_cleared(tmp_path: Path) -> None:
    (tmp_path / "spill-000017.bin").write_bytes(b"left")
    list(fuse([batch(ground(np.random.default_rng(0), 100, 5.0))], 0.1, 0.0, tmp_path, False))
    assert list(tmp_path.iterdir()) == []


def test_no_points_give_no_tiles(tmp_path: Path) -> None:
    assert list(fuse([], 0.1, 0.0, tmp_path, True)) == []
    assert list(fuse([batch(np.zeros((0, 3)))], 0.1, 0.0, tmp_path, True)) == []


def test_spacing_must_be_positive(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="spacing_m"):
        list(fuse([], 0.0, 0.0, tmp_path, True))


def test_images_behind_a_point_are_counted_once(tmp_path: Path) -> None:
    """Points that three images agreed on bring that along: two of them in a voxel are no six images."""
    batches = [
        replace(batch(np.full((1, 3), 0.5), source=k, confidence=0.7), views=np.full(1, 3, np.int32)) for k in (1, 2)
    ]
    (fused,) = fuse(batches, 1.0, 0.0, tmp_path, stray_filter=False)
    assert fused.views.tolist() == [3]
    assert fused.confidence == pytest.approx(0.7, abs=1e-6)
