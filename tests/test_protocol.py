"""Events survive the way through a line of text, jobs the way through a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.errors import InputError
from onthefly3r.protocol import Event, Job, Progress

values = st.one_of(st.none(), st.booleans(), st.integers(-(2**53), 2**53), st.text())
names = st.text(min_size=1).filter(lambda name: name not in ("kind", "time_s"))


@given(st.sampled_from(["progress", "warning", "result", "error"]), st.dictionaries(names, values))
def test_event_line_and_back(kind: str, data: dict[str, object]) -> None:
    event = Event(kind, data, time_s=1700000000.125)
    line = event.to_line()
    assert not {"\n", "\r"} & set(line)
    assert Event.from_line(line) == event


def test_progress_event_carries_every_count() -> None:
    report = Progress("mapping", 3, 9, placed=2, rejected=1, waiting=6, eta_s=4.5, message="batch 1")
    told = json.loads(Event.progress(report).to_line())
    assert told["kind"] == "progress"
    assert (told["stage"], told["done"], told["total"]) == ("mapping", 3, 9)
    assert (told["placed"], told["rejected"], told["waiting"], told["eta_s"]) == (2, 1, 6, 4.5)


@pytest.mark.parametrize("line", ["", "{}", "[1]", '{"kind": 3}', "reading photograph 3", '{"kind": "a"'])
def test_other_lines_are_refused(line: str) -> None:
    with pytest.raises(ValueError):
        Event.from_line(line)


@given(
    st.lists(st.text(alphabet=st.characters(exclude_categories=["Cs"]), min_size=1), max_size=3),
    st.dictionaries(st.sampled_from(["crs", "limit", "local"]), st.one_of(st.none(), st.booleans(), st.integers())),
)
def test_job_survives_the_file(tmp_path_factory: pytest.TempPathFactory, words: list[str], options: dict) -> None:
    path = tmp_path_factory.mktemp("job") / "job.json"
    job = Job("run", tuple(words), options)
    job.write(path)
    assert Job.read(path) == job


def test_job_keeps_a_file_name_that_is_no_text(tmp_path: Path) -> None:
    job = Job("run", (b"flight-\xff".decode("utf-8", "surrogateescape"), "out"))
    job.write(tmp_path / "job.json")
    assert Job.read(tmp_path / "job.json") == job


def test_job_becomes_the_command_line_of_its_verb() -> None:
    options = {"crs": "EPSG:32633", "local": False, "recursive": True, "limit": None, "common_with": ["a", "b"]}
    words = Job("run", ("-photos", "öut"), options).words()
    expected = "run --crs=EPSG:32633 --no-local --recursive --common-with=a --common-with=b --json -- -photos öut"
    assert words == expected.split()


@pytest.mark.parametrize("text", ["", "[]", '{"verb": "run"}', '{"verb": "--help", "arguments": [], "options": {}}'])
def test_job_file_of_something_else_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "job.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="is not a job"):
        Job.read(tmp_path / "job.json")
