"""What an analyst may get wrong, for each algorithm: the message names the cause, and nothing has started."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from survey_folder import make_run


@pytest.fixture(scope="module")
def here(qgis: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A place with a run, photographs, files of all kinds, and a folder that is somebody else's."""
    root = tmp_path_factory.mktemp("wröng inputs")
    make_run(root / "run", root / "photos")
    (root / "file.txt").write_text("text")
    (root / "empty").mkdir()
    (root / "taken").mkdir()
    (root / "taken" / "thesis.doc").write_text("years")
    (root / "broken run").mkdir()
    (root / "broken run" / "report.json").write_text("{")
    return root


PHOTOS, RUN = {"PHOTOS": "{here}/photos"}, {"RUN": "{here}/run"}
RECONSTRUCT = [
    ({}, "Folder of photographs: no folder is named"),
    ({"PHOTOS": "{here}/nowhere"}, "nowhere is no folder"),
    ({"PHOTOS": "{here}/file.txt"}, "file.txt is a file; name the folder that it is in"),
    ({**PHOTOS, "QUALITY": "best"}, "Quality: best is none of preview, standard, full"),
    ({**PHOTOS, "QUALITY": 3}, "Quality: 3 is none of"),
    ({**PHOTOS, "CRS": "EPSG:4326"}, "EPSG:4326 is in degrees"),
    ({**PHOTOS, "CRS": "EPSG:2263"}, "EPSG:2263 is in .*feet"),
    ({**PHOTOS, "CRS": "EPSG:999999"}, "EPSG:999999 is no coordinate reference system"),
    ({**PHOTOS, "CRS": "utm 33"}, "utm 33 is no coordinate reference system"),
    ({**PHOTOS, "VERTICAL": "sea"}, "Height reference: sea is none of .*auto"),
    ({**PHOTOS, "POSITIONS": "{here}/geo.txt"}, "Position file: .*geo.txt does not exist"),
    ({**PHOTOS, "POSITIONS": "{here}/empty"}, "Position file: .*empty does not exist, or is no file"),
    ({**PHOTOS, "CONTROL": "{here}/gcp.txt"}, "Ground control: .*gcp.txt does not exist"),
    ({**PHOTOS, "BACKBONE": "vggt2"}, "vggt2 is none of classical"),
    ({**PHOTOS, "BOUNDARY": "{here}/area.gpkg"}, "boundary layer .*area.gpkg cannot be read"),
    ({**PHOTOS, "BOUNDARY": "{here}/run/dsm.tif"}, "boundary layer .*dsm.tif cannot be read"),
    ({**PHOTOS, "EXTENT": "here"}, "here is no extent"),
    ({**PHOTOS, "EXTENT": "0,1,0,1"}, "extent has no coordinate reference system"),
    ({**PHOTOS, "OPTIONS": "thread=2"}, "thread is no option; did you mean threads"),
    ({**PHOTOS, "OPTIONS": "threads=-2"}, "threads: -2 is below the minimum"),
    ({**PHOTOS, "OPTIONS": "fast"}, "'fast' is neither name=value nor a file"),
    ({**PHOTOS, "OPTIONS": "crs=EPSG:25833", "CRS": "EPSG:25832"}, "crs is named .*name it once"),
    ({**PHOTOS, "OPTIONS": "control={here}/gone.csv"}, "Ground control: .*gone.csv does not exist"),
    ({**PHOTOS, "SPACING_M": -1.0}, "spacing_m: -1.0 is below the minimum"),
    ({**PHOTOS, "OUTPUT": "{here}/taken"}, "taken holds thesis.doc"),
    ({**PHOTOS, "OUTPUT": "{here}/file.txt"}, "file.txt is a file: name a folder"),
    ({**PHOTOS, "OUTPUT": "{here}/file.txt/out"}, "Nothing can be written into .*file.txt"),
    ({**PHOTOS, "OUTPUT": "{here}/photos"}, "output folder is that of the photographs"),
]
EARLIER = [
    ({}, "no folder is named"),
    ({"RUN": "{here}/nowhere"}, "nowhere is no folder"),
    ({"RUN": "{here}/file.txt"}, "file.txt is a file"),
    ({"RUN": "{here}/empty"}, "holds no report.json"),
]
CASES = {
    "reconstruct": RECONSTRUCT,
    "check": [
        *RECONSTRUCT[:12],
        ({**PHOTOS, "ABOVE_GROUND_M": -5.0}, "ABOVE_GROUND_M|Flying height|flying height"),
    ],
    "reconstructflights": [
        ({}, "either a parent folder of flights or a table"),
        ({"FOLDER": "{here}/photos", "TABLE": "{here}/file.txt"}, "either a parent folder of flights or a table"),
        ({"FOLDER": "{here}/nowhere"}, "Parent folder of the flights: .*nowhere is no folder"),
        ({"TABLE": "{here}/flights.csv"}, "Table of flights: .*flights.csv does not exist"),
        ({"TABLE": "{here}/empty"}, "Table of flights: .*is a folder; name a file"),
        *(({"FOLDER": "{here}/photos", **{k: v for k, v in given.items() if k not in ("PHOTOS",)}}, told)
          for given, told in [*RECONSTRUCT[3:12], *RECONSTRUCT[18:21], *RECONSTRUCT[23:27]]),
    ],
    "georeference": [
        *EARLIER,
        *(({**RUN, **{k: v for k, v in given.items() if k != "PHOTOS"}}, told)
          for given, told in [*RECONSTRUCT[5:13], *RECONSTRUCT[24:27]]),
        ({**RUN, "OUTPUT": "{here}/run"}, "output folder is that of the run"),
        ({**RUN, "LOCAL": True, "CRS": "EPSG:25833"}, "use only one of the two"),
        ({**RUN, "GPS_SIGMA_H_M": -1.0}, "GPS_SIGMA_H_M|below the minimum"),
    ],
    "exportcloud": [
        *EARLIER,
        ({**RUN, "OUTPUT": "{here}/cloud.xyz"}, "ends neither in .laz"),
        *(({**RUN, "OUTPUT": "{here}/c.laz", **{k: v for k, v in given.items() if k != "PHOTOS"}}, told)
          for given, told in [*RECONSTRUCT[5:9], *RECONSTRUCT[14:18]]),
        ({**RUN, "OUTPUT": "{here}/c.laz", "MIN_CONFIDENCE": 2.0}, "MIN_CONFIDENCE|above the maximum"),
    ],
    "exportcameras": [
        *EARLIER,
        *(({**RUN, "CRS": given["CRS"]}, told) for given, told in RECONSTRUCT[5:9]),
    ],
    "loadresults": [*EARLIER, ({"RUN": "{here}/broken run"}, "report.json cannot be read")],
    "evaluate": [
        *EARLIER,
        (RUN, "Give reference cameras, a reference cloud, or both"),
        ({**RUN, "REFERENCE_POSES": "{here}/images.txt"}, "Reference cameras, file: .*images.txt does not exist"),
        ({**RUN, "REFERENCE_POSES": "{here}/empty"}, "is a folder; name a file"),
        ({**RUN, "REFERENCE_FOLDER": "{here}/nowhere"}, "Reference cameras, folder: .*nowhere is no folder"),
        ({**RUN, "REFERENCE_FOLDER": "{here}/file.txt"}, "is a file; name the folder"),
        ({**RUN, "REFERENCE_CLOUD": "{here}/lidar.las"}, "Reference cloud: .*lidar.las does not exist"),
        ({**RUN, "REFERENCE_POSES": "{here}/file.txt", "REFERENCE_FOLDER": "{here}/empty"}, "not both"),
        ({**RUN, "REFERENCE_POSES": "{here}/file.txt", "ALIGN": "affine"}, "affine is none of sim3"),
        ({**RUN, "REFERENCE_CLOUD": "{here}/file.txt", "CLOUD_ALIGN": 7}, "7 is none of none, poses"),
    ],
    "sampleflight": [
        ({"OUTPUT": "{here}/taken"}, "taken holds thesis.doc"),
        ({"OUTPUT": "{here}/file.txt"}, "file.txt is a file"),
        ({"OUTPUT": "{here}/file.txt/out"}, "Nothing can be written"),
    ],
    "setup": [
        ({"EXISTING": "{here}/none"}, "is no Python that runs here"),
        ({"EXISTING": "{here}/file.txt"}, "is no Python that runs here"),
        ({"PYTHON": "{here}/none"}, "is no Python 3.10 or newer"),
    ],
}  # fmt: skip
ALL = [(name, given, told) for name, cases in CASES.items() for given, told in cases]


@pytest.mark.parametrize(("name", "given", "told"), ALL, ids=[f"{name}-{told[:30]}" for name, _, told in ALL])
def test_message_names_the_cause(
    qgis: Any, plugin: Any, here: Path, monkeypatch: pytest.MonkeyPatch, name: str, given: dict[str, Any], told: str
) -> None:
    from qgis.core import QgsProcessingException

    started: list[Any] = []
    monkeypatch.setattr(plugin("processing_algorithms.base"), "run_job", lambda *job: started.append(job))
    filled = {
        key: value.replace("{here}", str(here)) if isinstance(value, str) else value for key, value in given.items()
    }
    before = sorted(here.rglob("*"))
    with pytest.raises(QgsProcessingException, match=told) as raised:
        qgis.run(f"onthefly3r:{name}", filled)
    assert "Traceback" not in str(raised.value)
    assert not started
    assert sorted(here.rglob("*")) == before


def test_backbone_that_cannot_run_here_is_told_before_the_start(
    qgis: Any, plugin: Any, here: Path, monkeypatch: pytest.MonkeyPatch, feedback: Any
) -> None:
    from qgis.core import QgsProcessingException

    reconstruct, started = plugin("processing_algorithms.reconstruct"), []
    monkeypatch.setattr(plugin("processing_algorithms.base"), "run_job", lambda *job: started.append(job))
    described = [
        {"name": "pi3", "installed": False, "weights": "", "next_step": "pip install pi3"},
        {"name": "da3", "installed": True, "weights": "", "next_step": "download them"},
    ]
    monkeypatch.setattr(reconstruct, "describe_backbones", lambda *_: described)
    for name, told in (("pi3", "not installed: pip install pi3"), ("da3", "weights of da3 are missing: download")):
        with pytest.raises(QgsProcessingException, match=told):
            qgis.run("onthefly3r:reconstruct", {"PHOTOS": str(here / "photos"), "BACKBONE": name})
    assert not started
    with pytest.raises(QgsProcessingException, match="no backbone vggt: choose one of pi3, da3"):
        reconstruct.require_backbone(None, {"backbone": "vggt"}, feedback)
    reconstruct.require_backbone(None, {"backbone": "da3", "weights": "here"}, feedback)


def test_core_describes_its_backbones(plugin: Any, core_python: str) -> None:
    worker = plugin("plugin.worker")
    described = {item["name"]: item for item in worker.describe_backbones(core_python, lambda: False)}
    assert described["classical"]["installed"] and set(described) >= {"da3", "pi3", "vggt"}
    assert worker.describe_backbones("/nowhere/python", lambda: False) == []
