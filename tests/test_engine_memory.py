"""Stopped at any step, the engine goes on as if it never had been: the journals are the same to the last byte."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from onthefly3r.engine.loop import Engine
from onthefly3r.errors import Cancelled, InputError
from onthefly3r.options import Options
from onthefly3r.protocol import Progress
from onthefly3r.simulate.oracle import Faults, OracleBackbone, OracleDescriber, oracle_images, oracle_shots
from oracle_runs import GRID_PX, survey_of

FAULTS = Faults(bad_references=1, bad_reference_rate=0.3, bad_query_rate=0.5)


class Stopping:
    """Ends a run after so many subsets, as Ctrl-C does, or as a power cut does."""

    def __init__(self, after: int, killed: bool = False) -> None:
        self._left = after
        self._killed = killed

    def __call__(self, progress: Progress) -> None:
        self._left -= progress.stage != "reading photographs"
        if self._left < 0:
            if self._killed:
                os.kill(os.getpid(), signal.SIGKILL)
            raise Cancelled("stopped")


class WeakEyed(OracleDescriber):
    """A descriptor that must be taught, and tells when it was not."""

    known: np.ndarray | None = None

    def fit(self, images: Any) -> None:
        self.known = np.array(sorted(images))

    def learnt(self) -> dict[str, Any]:
        return {"known": self.known}

    def recall(self, learnt: Any) -> None:
        self.known = learnt["known"]

    def describe(self, index: int, image: Any) -> Any:
        assert self.known is not None and len(self.known) == 30
        return super().describe(index, image)


def advance(work: Path, progress: Any = None, live: bool = False, **options: Any) -> Engine:
    """Begin or take up a run of 60 photographs, and bring it to its end."""
    survey = survey_of(60, 4)
    images = {image.shot.name: image for image in oracle_images(survey, GRID_PX).values()}
    backbone = OracleBackbone(survey, None, FAULTS, 0, False, GRID_PX)
    engine = Engine(work, Options.from_flat(options), backbone, WeakEyed(survey), lambda s: images[s.name], progress)
    left = engine.take_up(oracle_shots(survey))
    backbone.calls = engine.backbone_calls  # what it draws depends on the number of the call
    if live:
        engine.advance()  # as far as the photographs that were added allow
        for shot in left:
            engine.add(shot)
    elif left:
        engine.add_all(left)
    engine.finish()
    return engine


@cache
def journal_of_whole_run(folder: Path, live: bool = False, preset: str = "default") -> bytes:
    advance(folder, live=live, preset=preset)
    return (folder / "journal.jsonl").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.getbasetemp() / "whole"


@pytest.mark.parametrize("after", [0, 1, 4, 9])
def test_a_run_that_was_stopped_ends_as_one_that_was_not(tmp_path: Path, whole: Path, after: int) -> None:
    expected = journal_of_whole_run(whole)
    with pytest.raises(Cancelled):
        advance(tmp_path, Stopping(after))
    before = (tmp_path / "journal.jsonl").read_bytes()
    assert len(before) < len(expected)
    engine = advance(tmp_path)
    assert (tmp_path / "journal.jsonl").read_bytes() == expected
    assert len(engine.state.frames) > 50 and engine.retries


def test_a_run_that_is_stopped_at_every_step_ends_all_the_same(tmp_path: Path, whole: Path) -> None:
    expected = journal_of_whole_run(whole)
    stops = 0
    while True:
        try:
            advance(tmp_path, Stopping(1))
            break
        except Cancelled:
            stops += 1
            assert stops < 100
    assert stops >= 5 and (tmp_path / "journal.jsonl").read_bytes() == expected


@pytest.mark.parametrize("how", [{"live": True}, {"preset": "paper"}])
def test_photographs_one_by_one_and_the_papers_way(tmp_path: Path, whole: Path, how: dict[str, Any]) -> None:
    expected = journal_of_whole_run(whole.with_name(f"whole {how}"), **how)
    with pytest.raises(Cancelled):
        advance(tmp_path, Stopping(5), **how)
    advance(tmp_path, **how)
    assert (tmp_path / "journal.jsonl").read_bytes() == expected


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_run_that_was_killed_ends_as_one_that_was_not(tmp_path: Path, whole: Path) -> None:
    """What was made of the photographs is lost with it, and made again."""
    expected = journal_of_whole_run(whole)
    code = f"import pathlib, test_engine_memory as t; t.advance(pathlib.Path({str(tmp_path)!r}), t.Stopping(6, True))"
    paths = [str(Path(__file__).parent), *sys.path]
    killed = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    for path in (tmp_path / "features").glob("*"):
        path.unlink()
    with (tmp_path / "journal.jsonl").open("ab") as journal:
        journal.write(b'{"submap": {"num')
    advance(tmp_path)
    assert (tmp_path / "journal.jsonl").read_bytes() == expected


def test_a_finished_run_has_nothing_left_to_do(tmp_path: Path, whole: Path) -> None:
    expected = journal_of_whole_run(whole)
    engine = advance(whole, Stopping(0))
    assert (whole / "journal.jsonl").read_bytes() == expected and engine.phase == "refined"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('{"spacing": {"fragment": 0, "spacing": 1.0}}', "older release"),
        ('{"step": {"set": {}, "gone": []}}', "steps are damaged"),
        ('{"step": {"set": {"phase": {"@": "Path"}}, "gone": []}}', "steps are damaged"),
        ('{"step": 3}', "steps are damaged"),
    ],
)
def test_what_cannot_be_gone_on_from_is_told(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / "journal.jsonl").write_text(line + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=said):
        advance(tmp_path)
