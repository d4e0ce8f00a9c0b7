"""A whole run from a folder of rendered photographs to files, with the classical backbone."""

from __future__ import annotations

import json
import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from onthefly3r import Options, reconstruct
from onthefly3r.commands.batch import Flight, read_flights
from onthefly3r.errors import Cancelled, GeoreferenceError, InputError, OptionError, ReconstructionError
from onthefly3r.evaluate.comparison import evaluate
from onthefly3r.intake.folder import read_photographs
from onthefly3r.options import IntakeOptions
from onthefly3r.protocol import Progress
from onthefly3r.run.export import export
from onthefly3r.run.result import Result
from onthefly3r.simulate import SurveyOptions, simulate_survey

FAST = {"dense_px": 200, "threads": 2}
LIGHT = {"quality": "preview", "rasters": False, "orthophoto": "none", "threads": 2}  # files that tests do not look at
FILES = (
    *("cloud.laz", "trajectory.csv", "preview.png", "report.json", "report.html"),
    *(f"{name}{suffix}" for name in ("cameras", "footprints") for suffix in (".shp", ".shx", ".dbf", ".prj", ".cpg")),
    *(f"colmap/{name}{suffix}" for name in ("cameras", "images", "points3D") for suffix in (".txt", ".bin")),
    *("colmap/offset.txt", "colmap/offset.json"),
    *(f"exchange/{name}" for name in ("opk.txt", "shots.geojson", "metashape.xml", "pix4d.csv", "calibration.json")),
)


class Later:
    """A cancel button that is pressed after it was looked at some times."""

    def __init__(self, times: int) -> None:
        self._left = times

    def __call__(self) -> bool:
        self._left -= 1
        return self._left < 0


@dataclass(frozen=True)
class Case:
    photos: Path
    truth: Path
    out: Path
    result: Result
    told: list[Progress]


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Twelve photographs in two strips, among files that are none; folders with spaces and umlauts."""
    folder = tmp_path_factory.mktemp("Flüge im Mai")
    simulate_survey(folder, SurveyOptions(images=12, strips=2, image_width_px=600, image_height_px=450, seed=2))
    photos, out = folder / "photos", folder / "Ergebnis für alle"
    first = sorted(photos.glob("*.JPG"))[0]
    (photos / "weitere").mkdir()
    first.rename(photos / "weitere" / first.name)
    (photos / "broken.jpg").write_bytes(sorted(photos.glob("*.JPG"))[0].read_bytes()[:3000])
    (photos / "no picture.jpg").write_text("hello", encoding="utf-8")
    if sys.platform == "linux":  # where names are bytes, one that is no text must not cost the whole run
        third = sorted(photos.glob("*.JPG"))[2]
        third.rename(third.with_name(os.fsdecode(b"bad \xff name.JPG")))
    told: list[Progress] = []
    result = reconstruct(photos, out, Options.from_flat(FAST), told.append)
    return Case(photos, folder / "truth", out, result, told)


def test_every_file_is_there_and_no_half_one(case: Case) -> None:
    for name in FILES:
        assert (case.out / name).stat().st_size > 0, name
    assert not [path for path in case.out.rglob("*") if "part" in path.suffixes or path.name.startswith(".")]
    assert sorted(path.name for path in (case.out / "work").iterdir()) == ["chunks", "journal.jsonl", "run.json"]
    assert not (case.out / "onthefly3r.lock").exists()


def test_report_counts_everything_that_was_given(case: Case) -> None:
    report = json.loads((case.out / "report.json").read_text(encoding="utf-8"))
    assert (
        (case.result.given, case.result.placed) == (report["images"]["given"], report["images"]["placed"]) == (14, 12)
    )
    rejected = {item["image"]: item for item in report["images"]["rejected"]}
    assert set(rejected) == {"broken.jpg", "no picture.jpg"}
    assert all(item["stage"] == "intake" and item["reason"] for item in rejected.values())
    assert report["georeference"]["crs"] == "EPSG:32633" and report["georeference"]["n_used"] == 12
    assert report["timing"]["own_s"] + report["timing"]["backbone_s"] == pytest.approx(report["timing"]["total_s"])
    assert report["memory"]["peak_rss_mib"] > 50


def test_cameras_and_cloud_are_where_they_were(case: Case) -> None:
    """Cameras to half a per cent of the flying height of 80 m, the cloud as it lies near the surface."""
    report = evaluate(case.out, case.truth, case.truth / "cloud.las")
    assert report.poses is not None and report.surface is not None
    assert report.poses.n_common == (11 if sys.platform == "linux" else 12)  # one has another name than in the truth
    assert report.poses.ate < 0.4
    assert report.surface.accuracy_median < 1.0


def test_cloud_is_read_by_others(case: Case) -> None:
    import laspy
    from pyproj import CRS

    with laspy.open(case.out / "cloud.laz") as stream:
        header, points = stream.header, stream.read()
    crs = CRS.from_wkt(next(v.string for v in header.vlrs if v.record_id == 2112))
    assert (str(header.version), header.point_format.id) == ("1.4", 7)
    assert crs.is_projected and "UTM zone 33N" in crs.name and len(crs.axis_info) == 3
    assert len(points) == case.result.report["cloud"]["points"] > 10_000
    assert header.global_encoding.wkt
    assert set(np.unique(points.point_source_id)) <= set(range(1, 15))


def test_progress_is_told_in_order(case: Case) -> None:
    stages = list(dict.fromkeys(progress.stage for progress in case.told))
    assert stages[0] == "reading photographs" and stages[-1] == "orthophoto"
    assert stages.index("starting the map") < stages.index("refining the cameras") < stages.index("georeferencing")
    assert all(progress.done <= progress.total for progress in case.told)


def test_export_again_in_another_crs(case: Case, tmp_path: Path) -> None:
    again = export(case.out, tmp_path / "again", Options.from_flat({**LIGHT, "crs": "EPSG:3035", "format": "las"}))
    assert again.report["georeference"]["crs"] == "EPSG:3035"
    assert (tmp_path / "again" / "cloud.las").exists() and not (tmp_path / "again" / "cloud.laz").exists()
    assert again.placed == 12


def test_without_positions_the_report_says_why_and_local_works(case: Case, tmp_path: Path) -> None:
    """A position file that knows two photographs only."""
    name = sorted(case.photos.glob("*.JPG"))[2].name
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{name} 15.0 48.0 300\n", encoding="utf-8")
    with pytest.raises(GeoreferenceError, match="--local"):
        export(case.out, tmp_path / "none", Options.from_flat({**LIGHT, "positions": str(tmp_path / "geo.txt")}))
    report = json.loads((tmp_path / "none" / "report.json").read_text(encoding="utf-8"))
    assert report["georeference"] is None and "position" in report["error"]
    assert not (tmp_path / "none" / "cloud.laz").exists()
    unknown = {**LIGHT, "local": True, "positions": str(tmp_path / "geo.txt")}
    local = export(case.out, tmp_path / "units", Options.from_flat(unknown))
    assert local.cloud is not None and local.report["georeference"] is None
    assert any("not metres" in warning for warning in local.report["warnings"])


def test_local_coordinates_are_metres_where_positions_tell(case: Case, tmp_path: Path) -> None:
    """The scale is that of twelve positions of 1.5 m (1 sigma) over 90 m."""
    local = export(case.out, tmp_path, Options.from_flat({**LIGHT, "local": True}))
    assert local.report["georeference"] is None
    assert [told for told in local.report["warnings"] if "are not placed" not in told] == []
    report = evaluate(tmp_path, case.truth, align="se3")
    assert report.poses is not None and report.poses.ate < 2.0


def test_cancelling_ends_the_run(case: Case, tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        reconstruct(case.photos, tmp_path / "out", Options.from_flat(FAST), cancel=lambda: True)
    assert not (tmp_path / "out" / "cloud.laz").exists()


def test_a_crs_that_will_not_do_is_told_before_the_work(case: Case, tmp_path: Path) -> None:
    for crs in ("EPSG:4326", "banana", "EPSG:2193"):  # not projected, unknown, of New Zealand
        with pytest.raises(OptionError, match="crs"):
            reconstruct(case.photos, tmp_path / "out", Options.from_flat({**FAST, "crs": crs}))
        with pytest.raises(OptionError, match="crs"):
            export(case.out, tmp_path / "out", Options.from_flat({"crs": crs}))
        assert not (tmp_path / "out").exists()


def listing(folder: Path) -> dict[str, bytes]:
    """What a user finds in a folder, but for the stamp, which changes."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "onthefly3r.json"
    }


def test_what_fails_or_is_cancelled_leaves_the_earlier_result_as_it_was(case: Case, tmp_path: Path) -> None:
    """An export that fails, and runs that are cancelled; the report of the failure lies beside."""
    out = tmp_path / "out"
    shutil.copytree(case.out, out)
    before = listing(out)
    assert "work/journal.jsonl" in before and "cloud.laz" in before
    with pytest.raises(ReconstructionError, match="no points") as failed:
        export(case.out, out, Options.from_flat({**LIGHT, "min_confidence": 1.0}))
    assert failed.value.report == out / "failed-report.json"
    assert "no points" in json.loads(failed.value.report.read_text(encoding="utf-8"))["error"]
    for _ in range(2):
        with pytest.raises(Cancelled):
            reconstruct(case.photos, out, Options.from_flat({**FAST, **LIGHT}), cancel=Later(2))
    after = listing(out)
    assert {name: after[name] for name in before} == before
    assert all(name.startswith(("failed-report.", "work/attempt-")) for name in set(after) - set(before))
    export(case.out, out, Options.from_flat(LIGHT))
    assert not (out / "failed-report.json").exists()


def test_a_map_that_cannot_be_georeferenced_stays_beside_the_earlier_result(case: Case, tmp_path: Path) -> None:
    """The new map is named, and a local export writes it."""
    out = tmp_path / "out"
    shutil.copytree(case.out, out)
    before = listing(out)
    name = sorted(case.photos.glob("*.JPG"))[2].name
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{name} 15.0 48.0 300\n", encoding="utf-8")
    few = Options.from_flat({**FAST, **LIGHT, "dense_px": 64, "positions": str(tmp_path / "geo.txt")})
    with pytest.raises(GeoreferenceError) as failed:
        reconstruct(case.photos, out, few)
    home = Path(str(failed.value.way_on).split("export ")[1].split(" NEW-FOLDER")[0])
    assert {name: held for name, held in listing(out).items() if name in before} == before
    assert export(home, tmp_path / "local", Options.from_flat({**LIGHT, "local": True})).placed == 12


def test_results_among_the_photographs_are_no_photographs(case: Case) -> None:
    out = case.photos / "result"
    export(case.out, out, Options.from_flat(LIGHT))
    assert (out / "preview.png").exists()
    shots, refused = read_photographs(case.photos, IntakeOptions(), leave_out=out)
    assert len(shots) + len(refused) == 14  # as without the results
    assert read_flights(case.photos, leave_out=out) == [Flight("weitere", case.photos / "weitere")]
    shutil.rmtree(out)


def test_photographs_that_share_nothing_end_with_a_report(tmp_path: Path) -> None:
    from PIL import Image

    rng = np.random.default_rng(0)
    (tmp_path / "photos").mkdir()
    for k in range(4):
        blocks = rng.integers(0, 255, (30, 40, 3), np.uint8)
        Image.fromarray(np.kron(blocks, np.ones((10, 10, 1), np.uint8))).save(tmp_path / "photos" / f"{k}.png")
    with pytest.raises(ReconstructionError, match="overlap"):
        reconstruct(tmp_path / "photos", tmp_path / "out", Options.from_flat(FAST))
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["images"]["placed"] == 0 and len(report["images"]["rejected"]) == 4


def test_a_folder_that_holds_something_else_is_left_alone(case: Case, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious", encoding="utf-8")
    with pytest.raises(InputError, match=r"thesis\.txt"):
        reconstruct(case.photos, tmp_path, Options.from_flat(FAST))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
