from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from onthefly3r.geometry.transforms import Sim3
from onthefly3r.options import Options
from onthefly3r.products.las import CloudSummary
from onthefly3r.products.report import RejectedImage, RunSummary, Timing, build_report, write_report
from onthefly3r.records import GeoReference

GEO = GeoReference(
    Sim3(12.5),
    46.8,
    -92.1,
    190.0,
    "EPSG:32615",
    "relative",
    "ransac+irls",
    17,
    1,
    0.4,
    float("nan"),
    warnings=("tilt",),
)
CLOUD = CloudSummary(Path("/out/cloud.laz"), 12, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0), (0.0, 1.0, 3.0, 4.0), 0.05)


def summary() -> RunSummary:
    rejected = [RejectedImage("a/é.jpg", "references", "does not fit", {"rotation_deg": np.float64(31.0)})]
    return RunSummary(
        options=Options(),
        backbone="classical",
        given=20,
        placed=18,
        rejected=rejected,
        timing=Timing(10.0, 6.0, {"backbone": 6.0, "export": 1.0}),
        georeference=GEO,
        cloud=CLOUD,
        warnings=("one",),
        backbone_facts={"name": "classical", "licence": "GPL", "weights": None},
        stage_memory={"export": {"peak_rss_mib": 500.0}},
        details={"submaps": np.int64(4), "covariance": np.array([1.0, np.inf])},
    )


def test_keys_and_values() -> None:
    report = build_report(summary(), 512.0)
    assert set(report["software"]) == {"version", "backbone", "command", "options"}
    assert report["software"]["options"]["batch_size"] == 5
    assert report["images"] == {
        "given": 20,
        "placed": 18,
        "rejected": [
            {"image": "a/é.jpg", "stage": "references", "reason": "does not fit", "numbers": {"rotation_deg": 31.0}}
        ],
    }
    assert report["georeference"] == {
        "crs": "EPSG:32615",
        "vertical": "relative",
        "scale": 12.5,
        "n_used": 17,
        "n_outliers": 1,
        "rmse_h_m": 0.4,
        "rmse_v_m": None,
        "method": "ransac+irls",
    }
    assert report["cloud"] == {
        "path": "cloud.laz",
        "points": 12,
        "bounds": [0, 1, 2, 3, 4, 5],
        "mean_spacing_m": 0.05,
        "mean_spacing": 0.05,
        "unit": "m",
    }
    assert report["timing"] == {
        "total_s": 10.0,
        "per_image_s": 0.5,
        "stages": {"backbone": 6.0, "export": 1.0},
        "backbone_s": 6.0,
        "own_s": 4.0,
    }
    assert report["memory"] == {"peak_rss_mib": 512.0, "stages": {"export": {"peak_rss_mib": 500.0}}}
    assert report["backbone"] == {"name": "classical", "licence": "GPL", "weights": None}
    assert report["warnings"] == ["one", "tilt"]
    assert report["details"] == {"submaps": 4, "covariance": [1.0, None]}


def test_a_run_that_failed_early_still_has_a_report(tmp_path: Path) -> None:
    early = RunSummary(Options(), "classical", 0, 0, (), Timing(0.1, 0.0), error="no positions")
    write_report(tmp_path / "report.json", build_report(early, None))
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["georeference"] is None
    assert report["cloud"] is None
    assert report["error"] == "no positions"
    assert report["timing"]["per_image_s"] is None


def test_strict_json_and_undecodable_names(tmp_path: Path) -> None:
    write_report(tmp_path / "report.json", {"a": float("nan"), "name": "x\udcff.jpg"})

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    read = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"), parse_constant=refuse)
    assert read == {"a": None, "name": "x\udcff.jpg"}
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_what_needs_attention_is_the_first_warning() -> None:
    report = build_report(replace(summary(), attention=("three are missing",)), None)
    assert report["attention"] == ["three are missing"]
    assert report["warnings"][:2] == ["three are missing", "one"]
