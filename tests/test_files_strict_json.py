"""Deep nesting is damage like any other."""

from __future__ import annotations

from pathlib import Path

import pytest

from onthefly3r.errors import InputError, ReferenceFormatError
from onthefly3r.evaluate.readers import scene_depth
from onthefly3r.files.strict_json import loads
from onthefly3r.protocol import Job
from onthefly3r.run.record import RunRecord

DEEP = "[" * 100_000


def test_what_is_sound_is_parsed() -> None:
    assert loads('{"a": [1, null]}') == {"a": [1, None]}


@pytest.mark.parametrize("text", ["", "{", DEEP, DEEP + "]" * 100_000])
def test_what_is_not_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError):
        loads(text)


def test_files_with_deep_nesting_are_refused(tmp_path: Path) -> None:
    for name in ("job.json", "run.json", "summary.json"):
        (tmp_path / name).write_text(DEEP)
    with pytest.raises(InputError, match=r"job\.json"):
        Job.read(tmp_path / "job.json")
    with pytest.raises(InputError, match=r"run\.json"):
        RunRecord.read(tmp_path)
    with pytest.raises(ReferenceFormatError, match=r"summary\.json"):
        scene_depth(tmp_path)
