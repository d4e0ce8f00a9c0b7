"""What a survey is called, where its results go, how long it takes; paths of Windows too."""

from __future__ import annotations

from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import pytest


@pytest.mark.parametrize(
    ("photos", "name"),
    [
        (PureWindowsPath(r"E:\DCIM\100MEDIA"), "100MEDIA"),
        (PureWindowsPath(r"E:\2026-05 quarry\DCIM\100MEDIA"), "2026-05 quarry"),
        (PureWindowsPath(r"C:\Users\Anna\surveys\Köln Süd\Fotos"), "Köln Süd"),
        (PureWindowsPath(r"\\server\share\flights\field 7\images"), "field 7"),
        (PureWindowsPath("D:\\"), "D"),
        (PurePosixPath("/surveys/2026-05-14 quarry/photos"), "2026-05-14 quarry"),
        (PurePosixPath("/media/card/DCIM/DJI_202605141030_001_Quarry"), "DJI_202605141030_001_Quarry"),
        (PurePosixPath("/photos"), "photos"),
        (PurePosixPath("/"), "survey"),
        (PurePosixPath('/a/what: a "name"?'), "what  a  name"),
    ],
)
def test_name_of_a_survey(plugin: Any, photos: Any, name: str) -> None:
    told = plugin("plugin.places").survey_name(photos)
    assert " ".join(told.split()) == " ".join(name.split())


def test_results_go_beside_the_photographs(plugin: Any, tmp_path: Path) -> None:
    places = plugin("plugin.places")
    photos, documents = tmp_path / "quarry" / "photos", tmp_path / "Documents"
    photos.mkdir(parents=True)
    first = places.default_output(photos, None, documents)
    assert first == tmp_path / "quarry" / "quarry reconstructed"
    first.mkdir()
    (first / ".DS_Store").write_text("")
    assert places.default_output(photos, None, documents) == first
    (first / "report.json").write_text("{}")
    assert places.default_output(photos, None, documents).name == "quarry reconstructed 2"
    again = places.default_output(first, None, documents, what="georeferenced")
    assert again == tmp_path / "quarry" / "quarry georeferenced"


def test_results_of_a_card_go_to_the_project_or_the_documents(plugin: Any, tmp_path: Path) -> None:
    default = plugin("plugin.places").default_output
    card, project, documents = tmp_path / "DCIM" / "100MEDIA", tmp_path / "project", tmp_path / "Documents"
    card.mkdir(parents=True)
    project.mkdir()
    assert default(card, project, documents).parent == project
    assert default(card, None, documents).parent == documents / "On-the-Fly3R"
    assert default(card.parent, tmp_path / "gone", documents).parent == documents / "On-the-Fly3R"
    plain = tmp_path / "flight"
    assert default(plain, project, documents, lambda folder: folder == project).parent == project


@pytest.mark.parametrize(
    ("path", "url"),
    [
        ("/a b/ü#1.jpg", "file:///a%20b/%C3%BC%231.jpg"),
        (r"C:\a b\50%.jpg", "file:///C:/a%20b/50%25.jpg"),
        (r"\\server\share\x.jpg", "file://server/share/x.jpg"),
    ],
)
def test_addresses_of_files(plugin: Any, path: str, url: str) -> None:
    assert plugin("plugin.places").file_url(path) == url


def test_time_left(plugin: Any) -> None:
    now = [0.0]
    left = plugin("plugin.timeleft").TimeLeft(lambda: now[0])
    assert left.text(0.5) == ""  # too early to tell
    now[0] = 60.0
    assert left.text(0.25) == "about 3 minutes left"
    assert left.text(0.01) == left.text(1.0) == ""
    assert left.text(0.9) == "less than a minute left"
    now[0] = 3600.0
    assert left.text(0.5) == "about 1 h left" and left.text(0.4) == "about 1 h 30 min left"


def test_progress_tells_counts_and_time(plugin: Any, feedback: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    base, event = plugin("processing_algorithms.base"), plugin("core.onthefly3r.protocol").Event
    now = [0.0]
    clock = plugin("plugin.timeleft").TimeLeft
    monkeypatch.setattr(base, "TimeLeft", lambda: clock(lambda: now[0]))
    listener = base.FeedbackListener(feedback, {"reconstructing": (0, 100)})
    told: list[str] = []
    feedback.on_progress = told.append
    now[0] = 120.0
    listener.event(
        event("progress", {"stage": "reconstructing", "done": 50, "total": 100, "placed": 40, "rejected": 2})
    )
    assert told == ["reconstructing 50/100 (40 placed, 2 rejected); about 2 minutes left"]
    for _ in range(3):
        listener.event(event("warning", {"message": "only 3 of 9"}))
    assert feedback.told.count("only 3 of 9") == 1


def test_few_placed_photographs_are_told_first(plugin: Any) -> None:
    warnings_of = plugin("processing_algorithms.results").warnings_of

    def told(placed: int, *warnings: str) -> list[str]:
        return list(warnings_of({"images": {"given": 100, "placed": placed}, "warnings": warnings}))

    assert told(90) == [] and told(100, "a", "a") == ["a"]
    assert (
        told(89, "tilted")[0].startswith("Only 89 of 100 photographs were placed") and told(89, "tilted")[1] == "tilted"
    )
    assert told(40, "only 40 of 100 photographs are in the result") == ["only 40 of 100 photographs are in the result"]


def test_bar_knows_every_stage_of_the_core_and_never_goes_back(plugin: Any, feedback: Any) -> None:
    import ast

    base, event = plugin("processing_algorithms.base"), plugin("core.onthefly3r.protocol").Event
    tellers = {"checkpoint", "_checkpoint", "_progress", "each", "Progress"}
    core = Path(__file__).resolve().parents[2] / "core" / "onthefly3r"
    told = {
        call.args[0].value
        for folder in ("engine", "cloud", "products", "run")
        for path in (core / folder).rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call) and call.args and isinstance(call.args[0], ast.Constant)
        if ast.unparse(call.func).rpartition(".")[2] in tellers
    }
    assert len(told) > 8
    assert told <= set(base.RUN_STAGES)
    shown: list[float] = []
    feedback.progressChanged.connect(shown.append)
    listener = base.FeedbackListener(feedback, base.RUN_STAGES)
    for stage in ("reading photographs", "reconstructing", "something new", "reading photographs again", "orthophoto"):
        for done in (0, 1, 2):
            listener.event(event("progress", {"stage": stage, "done": done, "total": 2}))
    assert shown == sorted(shown) and shown[-1] == 99.0
    assert all(0 <= begin < end <= 100 for begin, end in base.EXPORT_STAGES.values())
