"""Results of other programs come in by npz, TUM and COLMAP, and stand in the paper's tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from onthefly3r.errors import InputError, ReferenceFormatError
from onthefly3r.geometry.transforms import Rigid3, rotation_exp
from paper import published
from paper.__main__ import main
from paper.datasets import read_scene
from paper.measured import measure, measure_all
from paper.results import read_result, write_result
from paper.tables import beside, geometry_table, macro_table, per_scene_table, seven_scenes_table

NAMES = [f"img_{k}.jpg" for k in range(12)]


def truth() -> dict[int, Rigid3]:
    """Cameras on a bent line."""
    return {
        k: Rigid3(rotation_exp(np.array([0.0, 0.02 * k, 0.1])), np.array([2.0 * k, 0.1 * k * k, 50.0 + (k % 3)]))
        for k in range(12)
    }


def write_colmap(folder: Path, poses: dict[int, Rigid3]) -> None:
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    lines = []
    for k, pose in poses.items():
        inverse = pose.inverse()
        x, y, z, w = Rotation.from_matrix(inverse.rotation).as_quat()
        t = " ".join(repr(float(v)) for v in inverse.translation)
        lines += [f"{k + 1} {w} {x} {y} {z} {t} 1 {NAMES[k]}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def assert_poses(path: Path, images: list[str] | tuple[str, ...] = (), count: int = 12) -> None:
    found = read_result(path, images)
    assert found.names == tuple(NAMES[:count])
    for k, pose in list(truth().items())[:count]:
        np.testing.assert_allclose(found.centres[k], pose.translation, atol=1e-6)
        np.testing.assert_allclose(found.rotations[k], pose.rotation, atol=1e-6)


def test_npz_round_trip(tmp_path: Path) -> None:
    write_result(tmp_path / "a" / "HAV.npz", NAMES, truth())
    assert_poses(tmp_path / "a" / "HAV.npz")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["HAV.npz"]


@pytest.mark.parametrize(("names", "poses"), [("image_paths", "cam2world"), (None, "camera_poses"), ("names", "poses")])
def test_npz_of_other_programs(tmp_path: Path, names: str | None, poses: str) -> None:
    matrices = np.stack([pose.matrix() for pose in truth().values()])[:, :3]
    matrices[-1, 0, 0] = np.nan
    valid = np.ones(12, bool)
    valid[-2] = False
    arrays = {poses: matrices, "valid": valid}
    if names is not None:
        arrays[names] = np.array(NAMES)
    np.savez(tmp_path / "r.npz", **arrays)
    assert_poses(tmp_path / "r.npz", NAMES if names is None else (), count=10)


@pytest.mark.parametrize("stamp", ["number", "name"])
def test_tum_by_number_or_by_name(tmp_path: Path, stamp: str) -> None:
    from scipy.spatial.transform import Rotation

    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for k, pose in truth().items():
        numbers = [*pose.translation, *Rotation.from_matrix(pose.rotation).as_quat()]
        lines.append(" ".join([str(k) if stamp == "number" else NAMES[k], *map(repr, map(float, numbers))]))
    (tmp_path / "r.txt").write_text("\n".join(lines), encoding="utf-8")
    assert_poses(tmp_path / "r.txt", NAMES)


def test_colmap_text_and_binary(tmp_path: Path) -> None:
    write_colmap(tmp_path / "text" / "sparse" / "0", truth())
    # natural order of names: img_2 before img_10
    assert_poses(tmp_path / "text")
    import pycolmap

    (tmp_path / "text" / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 100 80 90 90 50 40\n", encoding="utf-8")
    (tmp_path / "text" / "sparse" / "0" / "points3D.txt").write_text("", encoding="utf-8")
    (tmp_path / "binary" / "sparse" / "0").mkdir(parents=True)
    pycolmap.Reconstruction(str(tmp_path / "text" / "sparse" / "0")).write_binary(
        str(tmp_path / "binary" / "sparse" / "0")
    )
    assert_poses(tmp_path / "binary")


@pytest.mark.parametrize(
    ("arrays", "told"),
    [
        ({"points": np.zeros((3, 3))}, "holds none of"),
        ({"cam2world": np.zeros((3, 16)), "names": np.array(NAMES[:3])}, "shape"),
        ({"cam2world": np.tile(np.eye(4), (3, 1, 1)), "names": np.array(NAMES[:2])}, "2 names"),
        ({"cam2world": np.full((3, 4, 4), np.nan), "names": np.array(NAMES[:3])}, "no camera pose"),
        ({"cam2world": np.tile(2.0 * np.eye(4), (3, 1, 1)), "names": np.array(NAMES[:3])}, "no rotation"),
        ({"cam2world": np.tile(np.eye(4), (3, 1, 1)), "names": np.array(NAMES[:3], object)}, "must be text"),
    ],
)
def test_what_is_wrong_with_an_npz_is_told(tmp_path: Path, arrays: dict[str, np.ndarray], told: str) -> None:
    np.savez(tmp_path / "r.npz", **arrays)
    with pytest.raises(ReferenceFormatError, match=told):
        read_result(tmp_path / "r.npz")


def test_a_file_that_is_no_npz_or_missing(tmp_path: Path) -> None:
    (tmp_path / "r.npz").write_bytes(b"PK\x03\x04 no zip")
    with pytest.raises(ReferenceFormatError, match="cannot be read"):
        read_result(tmp_path / "r.npz")
    with pytest.raises(ReferenceFormatError, match="no such file"):
        read_result(tmp_path / "s.npz")


# ------------------------------------------------------------------ tables


def shaken(seed: int, sigma: float) -> dict[int, Rigid3]:
    rng = np.random.default_rng(seed)
    return {k: Rigid3(p.rotation, 3.0 * (p.translation + sigma * rng.standard_normal(3))) for k, p in truth().items()}


def write_ply(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_text(head + "\n".join(" ".join(map(str, p)) for p in points) + "\n", encoding="ascii")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """The six outdoor scenes in miniature; results of two methods, the second of which failed in Campus."""
    cloud = np.random.default_rng(0).uniform(0.0, 20.0, (400, 3))
    for scene in published.OUTDOOR:
        part = "urban" if scene in ("Residence", "Campus") else "gauu"
        root = tmp_path / part / scene
        write_colmap(root / "sparse" / "0", truth())
        for name in NAMES:
            path = root / ("photos" if part == "urban" else "images") / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
        write_ply(root / "lidar.ply", cloud)
        ours = tmp_path / "results" / "On-the-Fly3R (Pi3x)"
        write_result(ours / f"{scene}.npz", NAMES, {k: p for k, p in shaken(1, 0.05).items() if k > 1})
        (ours / f"{scene}.json").write_text(json.dumps({"seconds": 6.0, "peak_gpu_gb": 9.5}), encoding="utf-8")
        write_ply(ours / f"{scene}.ply", 3.0 * cloud)
        if scene != "Campus":
            write_result(tmp_path / "results" / "MERG3R" / f"{scene}.npz", NAMES, shaken(2, 1.0))
    return tmp_path


def scenes_of(data: Path) -> dict[str, object]:
    return {
        name: read_scene(name, data / ("urban" if name in ("Residence", "Campus") else "gauu"))
        for name in published.OUTDOOR
    }


def row(table: str, method: str) -> list[str]:
    line = next(line for line in table.splitlines() if f"| {method} |" in line)
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_tables_stand_beside_the_papers_numbers(data: Path) -> None:
    results = measure_all(data / "results", scenes_of(data))  # type: ignore[arg-type]
    ours, other = results["On-the-Fly3R (Pi3x)"], results["MERG3R"]
    assert ours["HAV"].errors.ate == pytest.approx(0.05 * np.sqrt(3), rel=0.4)  # type: ignore[union-attr]
    assert ours["HAV"].placed == 10 and ours["HAV"].errors.coverage == pytest.approx(10 / 12)  # type: ignore[union-attr]
    table = row(per_scene_table(results), "On-the-Fly3R (Pi3x)")
    assert table[1].endswith("(4.20)") and table[7] == "83.33 (95.39)"
    merged = row(per_scene_table(results), "MERG3R")
    assert merged[6] == "- (492.95)" and merged[7] == "83.33 (100.00)"
    assert row(per_scene_table(results), "FastVGGT")[1:] == ["(OOM)"] * 6 + ["(0.00)"]

    # Common frames: those that ours accepted; a method that failed in one scene has no mean.
    assert other["HAV"].common.n_common == 10 and other["HAV"].errors.n_common == 12  # type: ignore[union-attr]
    assert row(macro_table(results), "MERG3R")[1] == "- (124.42)"
    means = row(macro_table(results), "On-the-Fly3R (Pi3x)")
    expected = np.mean([r.common.ate for r in ours.values()])  # type: ignore[union-attr]
    assert means[1] == f"{expected:.2f} (18.56)" and means[2].endswith("(2.78)")

    geometry = row(geometry_table(results), "On-the-Fly3R (Pi3x)")
    assert geometry[1] == "6/6 (6/6)" and geometry[5] == "0.500 (0.814)" and geometry[6] == "9.50 (17.56)"
    # Three times as large as the truth: the fit of the cameras brings the cloud back.
    assert float(geometry[4].split()[0]) < 0.5
    assert row(geometry_table(results), "MERG3R")[1:3] == ["0/6 (6/6)", "- (24.69)"]


def test_a_method_that_knows_nothing_of_the_scene_is_told(data: Path) -> None:
    write_result(data / "results" / "Odd" / "HAV.npz", ["other.jpg"] * 1, {0: Rigid3()})
    with pytest.raises(ReferenceFormatError, match=r"other\.jpg"):
        measure(data / "results" / "Odd", scenes_of(data)["HAV"])  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no folder"):
        measure_all(data / "nothing", {})


def test_time_and_memory_come_from_our_report_too(data: Path) -> None:
    folder = data / "results" / "Mine" / "HAV"
    write_colmap(folder, truth())
    memory = {
        "peak_rss_mib": 900.0,
        "stages": {"retrieval": {"peak_gpu_mib": 500.0}, "backbone": {"peak_gpu_mib": 9000.0}},
    }
    (folder / "report.json").write_text(json.dumps({"timing": {"total_s": 24.0}, "memory": memory}), encoding="utf-8")
    found = measure(data / "results" / "Mine", scenes_of(data)["HAV"])  # type: ignore[arg-type]
    assert found.seconds == 24.0 and found.peak_gpu_gb == pytest.approx(9.437, abs=1e-3)
    (folder / "report.json").write_text('{"timing": {}}', encoding="utf-8")
    with pytest.raises(ReferenceFormatError, match=r"report\.json"):
        measure(data / "results" / "Mine", scenes_of(data)["HAV"])  # type: ignore[arg-type]


def test_the_command_prints_all_outdoor_tables(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    roots = ["--gauu-scene", str(data / "gauu"), "--urban-scene", str(data / "urban")]
    assert main(["compare", str(data / "results"), *roots]) == 0
    printed = capsys.readouterr().out
    assert "HAV 424" in printed and "(18.56)" in printed and "Peak GPU GB" in printed and "7-Scenes" not in printed
    assert main(["compare", str(data / "results")]) == 2
    assert "--gauu-scene" in capsys.readouterr().err


def test_seven_scenes_are_told_in_centimetres(tmp_path: Path) -> None:
    folder = tmp_path / "seven" / "chess" / "seq-01"
    folder.mkdir(parents=True)
    for k in range(0, 60, 5):
        (folder / f"frame-{k:06d}.color.png").write_bytes(b"")
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", truth()[k // 5].matrix())
    for k in range(60):
        (folder / f"frame-{k:06d}.color.png").write_bytes(b"")
    scene = read_scene("Chess", tmp_path / "seven")
    write_result(tmp_path / "r" / "Mine" / "Chess.npz", scene.names, shaken(1, 0.01))
    results = measure_all(tmp_path / "r", {"Chess": scene})
    cells = row(seven_scenes_table(results), "Mine")
    assert float(cells[1].split()[0]) == pytest.approx(100.0 * results["Mine"]["Chess"].errors.ate, abs=0.005)  # type: ignore[union-attr]
    assert cells[1].endswith("(-)") and cells[8] == "- (-)"
    assert row(seven_scenes_table(results), "VGGT-Long")[8] == "(6.23)"


@pytest.mark.parametrize(
    ("measured", "told", "was_run", "cell"),
    [(1.234, 5.0, True, "1.23 (5.00)"), (None, 5.0, True, "- (5.00)"), (None, published.OOM, False, "(OOM)")],
)
def test_a_cell(measured: float | None, told: float | None, was_run: bool, cell: str) -> None:
    assert beside(measured, told, 2, was_run) == cell


def test_the_papers_numbers_agree_among_themselves() -> None:
    for method, values in published.SEVEN_SCENES.items():
        assert np.mean(values[:7]) == pytest.approx(values[7], abs=0.006), method
    per_scene = published.POSE_PER_SCENE["On-the-Fly3R (Pi3x)"]
    assert np.mean([v for v in per_scene[:6] if v is not None]) == pytest.approx(
        published.POSE_MACRO["On-the-Fly3R (Pi3x)"][0], abs=0.01
    )
    for method, geometry in published.GEOMETRY_EFFICIENCY.items():
        assert (geometry.accuracy + geometry.completeness) / 2 == pytest.approx(geometry.chamfer, abs=0.011), method
    assert sum(published.OUTDOOR.values()) == 12155
    assert published.ABLATION[5].hav[0] == published.POSE_PER_SCENE["On-the-Fly3R (VGGT-Omega)"][0]
    assert published.ABLATION[5].residence[0] == published.POSE_PER_SCENE["On-the-Fly3R (VGGT-Omega)"][4]
    better = [
        published.VFM_COMPARISON[backbone, "On-the-Fly3R"][scene] < published.VFM_COMPARISON[backbone, "Vanilla"][scene]
        for backbone in ("MapAnything", "Pi3", "Pi3x", "VGGT", "VGGT-Omega")
        for scene in (0, 1)
    ]
    assert sum(better) == 7  # "outperforms native inference in 7 out of 10 model-scene combinations"
