"""Whose files are whose: claims, swaps that are cut short, planted links, and what reaches the disk in which order."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from onthefly3r.errors import BusyError, InputError, OnTheFly3RError, StorageError
from onthefly3r.files import atomic, owned
from onthefly3r.files.lock import LOCK_NAME
from onthefly3r.files.owned import OwnedFolder
from onthefly3r.files.ownership import STAMP_NAME, read_stamp
from onthefly3r.files.room import storage_errors

ROOT = Path(__file__).resolve().parents[1]
POSIX = pytest.mark.skipif(os.name == "nt", reason="of POSIX systems")


class PowerCut(BaseException):
    """The machine is gone: nothing of ours runs any more."""


def put(folder: Path, **files: str) -> None:
    """Publish files, named a__b_txt for a/b.txt, as the whole group `result`."""
    with OwnedFolder.claim(folder, "test") as held, held.scratch() as made:
        write(made, **files)
        held.publish(made, "result")


def write(folder: Path, **files: str) -> None:
    for name, text in files.items():
        path = folder / name.replace("__", "/").replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def seen(folder: Path) -> dict[str, str]:
    """All files but stamp and lock."""
    return {
        path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8")
        for path in folder.rglob("*")
        if path.is_file() and path.name not in (STAMP_NAME, LOCK_NAME)
    }


def test_group_is_replaced_as_a_whole_and_nothing_else_goes(tmp_path: Path) -> None:
    out = tmp_path / "a" / "out"
    put(out, cloud_laz="1", colmap__cameras_txt="1")
    write(out, notes_txt="mine", work__thesis_txt="mine", cloud_qgz="mine")
    put(out, cloud_las="2")
    assert seen(out) == {"cloud.las": "2", "notes.txt": "mine", "work/thesis.txt": "mine", "cloud.qgz": "mine"}
    assert not (out / "colmap").exists()
    assert not (out / LOCK_NAME).exists()


@pytest.mark.parametrize("plant", ["thesis.txt", "report.json", "work/crash.txt", STAMP_NAME])
def test_folder_of_somebody_else_is_refused_and_unchanged(plant: str, tmp_path: Path) -> None:
    place = tmp_path / plant
    place.parent.mkdir(exist_ok=True)
    place.write_text('{"files": {}}', encoding="utf-8")
    with pytest.raises(InputError):
        put(tmp_path, cloud_laz="1")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [place]


def test_file_of_the_users_at_one_of_our_names_is_refused_by_name(tmp_path: Path) -> None:
    put(tmp_path, cloud_laz="1")
    (tmp_path / "cameras.csv").write_text("the user's own", encoding="utf-8")
    (tmp_path / "cloud.laz").write_text("edited by the user", encoding="utf-8")
    before = seen(tmp_path)
    for name in ("cameras_csv", "cloud_laz"):
        with pytest.raises(InputError, match=name.replace("_", r"\.")):
            put(tmp_path, **{name: "2"})
        with (
            pytest.raises(InputError, match=name.replace("_", r"\.")),
            OwnedFolder.claim(tmp_path, "test", names=[name.replace("_", ".")]),
        ):
            pass
        assert seen(tmp_path) == before
    put(tmp_path, other_txt="3")  # the edited one is no longer ours, and stays
    assert seen(tmp_path) == {**before, "other.txt": "3"}


def test_guest_leaves_a_foreign_folder_alone_but_for_its_own_files(tmp_path: Path) -> None:
    write(tmp_path, thesis_txt="mine", work__data_txt="mine")
    with OwnedFolder.claim(tmp_path, "test", guest=True, names=["flights.csv"]) as held, held.scratch() as made:
        write(made, flights_csv="1")
        held.publish(made, "flights")
    assert seen(tmp_path) == {"thesis.txt": "mine", "work/data.txt": "mine", "flights.csv": "1"}
    write(tmp_path, check_csv="mine")
    with (
        pytest.raises(InputError, match=r"check\.csv"),
        OwnedFolder.claim(tmp_path, "t", guest=True, names=["check.csv"]),
    ):
        pass


def test_claim_that_writes_nothing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), OwnedFolder.claim(tmp_path / "a" / "b", "test") as held, held.scratch():
        raise ZeroDivisionError
    assert not (tmp_path / "a").exists()


def test_block_that_fails_leaves_the_earlier_files(tmp_path: Path) -> None:
    put(tmp_path, cloud_laz="1")
    with pytest.raises(ZeroDivisionError), OwnedFolder.claim(tmp_path, "test") as held, held.scratch() as made:
        write(made, cloud_laz="2")
        raise ZeroDivisionError
    assert seen(tmp_path) == {"cloud.laz": "1"}
    assert not (tmp_path / "work").exists()


# ---------------------------------------------------------------------- power cuts


def steps_of(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None], cut: int | None) -> list[str]:
    """Run `act` until its step number `cut` of syncing or renaming, and return the steps."""
    steps: list[str] = []

    def step(kind: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def do(first: Any, *rest: Any) -> Any:
            if len(steps) == cut:
                raise PowerCut
            steps.append(f"{kind} {first}" + (f" -> {rest[0]}" if rest else ""))
            return real(first, *rest)

        return do

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", step("rename", Path.replace))
        syncing = step("sync", atomic.sync_file), step("sync folder", atomic.sync_folder)
        for module in (atomic, owned):
            patched.setattr(module, "sync_file", syncing[0])
            patched.setattr(module, "sync_folder", syncing[1])
        if cut is None:
            act()
        else:
            with pytest.raises(PowerCut):
                act()
    return steps


def test_every_file_is_synced_before_it_gets_its_name_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tmp_path, cloud_laz="1", gone_txt="1")
    steps = steps_of(monkeypatch, lambda: put(tmp_path, cloud_laz="2", colmap__cameras_txt="2"), None)
    for name in ("cloud.laz", "colmap/cameras.txt", STAMP_NAME):
        target = tmp_path / name
        named = [
            number for number, step in enumerate(steps) if step.startswith("rename") and step.endswith(f"-> {target}")
        ]
        for number in named:
            source = steps[number].removeprefix("rename ").split(" -> ")[0]
            assert f"sync {source}" in steps[:number], name
            assert f"sync folder {target.parent}" in steps[number:], name
        assert named


def test_power_cut_at_any_moment_leaves_all_old_or_all_new_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = {"cloud.laz": "1", "gone.txt": "1", "notes.txt": "mine"}
    new = {"cloud.laz": "2", "colmap/cameras.txt": "2", "notes.txt": "mine"}
    whole = tmp_path / "whole"
    put(whole, cloud_laz="1", gone_txt="1")
    write(whole, notes_txt="mine")
    # What a killed process does on its way out must not count: no clean-up runs after a power cut.
    with monkeypatch.context() as patched:
        patched.setattr(OwnedFolder, "_end", lambda self: None)
        patched.setattr(OwnedFolder, "drop_scratch", lambda self, name: None)
        shutil.copytree(whole, tmp_path / "counted")
        count = len(
            steps_of(monkeypatch, lambda: put(tmp_path / "counted", cloud_laz="2", colmap__cameras_txt="2"), None)
        )
    assert count > 10
    states = []
    for cut in range(count):
        out = tmp_path / f"cut {cut}"
        shutil.copytree(whole, out)
        with monkeypatch.context() as patched:
            patched.setattr(OwnedFolder, "_end", lambda self: None)
            patched.setattr(OwnedFolder, "drop_scratch", lambda self, name: None)
            steps_of(monkeypatch, lambda: put(out, cloud_laz="2", colmap__cameras_txt="2"), cut)  # noqa: B023
        with OwnedFolder.claim(out, "after"):
            pass
        state = seen(out)
        assert state in (old, new), f"after {cut} steps"
        assert not (out / "work").exists()
        states.append(state == new)
    assert states == sorted(states) and 0 < sum(states) < count


def test_swap_that_the_system_refuses_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows, where a file that another program shows cannot be replaced."""
    put(tmp_path, a_txt="1", b_txt="1", c_txt="1")
    real = Path.replace

    def refuse(self: Path, target: Path) -> Path:
        if self == tmp_path / "b.txt":
            raise PermissionError(13, "in use", str(self))
        return real(self, target)

    with monkeypatch.context() as patched, pytest.raises(StorageError, match=r"b\.txt.*close the program"):
        patched.setattr(Path, "replace", refuse)
        put(tmp_path, a_txt="2", b_txt="2", d_txt="2")
    assert seen(tmp_path) == {"a.txt": "1", "b.txt": "1", "c.txt": "1"}
    put(tmp_path, a_txt="2")
    assert seen(tmp_path) == {"a.txt": "2"}


def test_scratch_that_a_killed_process_left_is_swept(tmp_path: Path) -> None:
    put(tmp_path, a_txt="1")
    with OwnedFolder.claim(tmp_path, "test") as held:
        left = tmp_path / held.new_scratch("new")
        write(left, big_bin="x")
        write(tmp_path, work__thesis_txt="mine")
    assert left.exists()
    put(tmp_path, a_txt="2")
    assert seen(tmp_path) == {"a.txt": "2", "work/thesis.txt": "mine"}


# ---------------------------------------------------------------------- links and forged stamps


@POSIX
def test_planted_links_are_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    write(victim, keep_txt="keep")
    out = tmp_path / "out"
    put(out, cloud_laz="1")
    (out / "cloud.laz").unlink()
    (out / "cloud.laz").symlink_to(victim / "keep.txt")
    with pytest.raises(InputError, match=r"cloud\.laz"):
        put(out, cloud_laz="2")
    (out / "work").symlink_to(victim)
    with pytest.raises(InputError, match="work"):
        put(out, other_txt="2")
    (out / "work").unlink()
    (out / LOCK_NAME).symlink_to(victim / "keep.txt")
    with pytest.raises(InputError, match="lock"):
        put(out, other_txt="2")
    assert seen(victim) == {"keep.txt": "keep"}


def test_temporary_names_cannot_be_foretold(tmp_path: Path) -> None:
    names = []
    for _ in range(2):
        with atomic.replacing(tmp_path / "cloud.laz") as temporary:
            names.append(temporary.name)
            with pytest.raises(FileExistsError):
                atomic.create_exclusively(temporary)
            temporary.write_bytes(b"x")
    assert len({*names}) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.laz"]


@pytest.mark.parametrize(
    "name", ["../victim.txt", "/etc/passwd", "C:/victim.txt", "a/../../victim.txt", "..\\victim.txt"]
)
def test_stamp_that_names_files_elsewhere_is_refused(name: str, tmp_path: Path) -> None:
    put(tmp_path, a_txt="1")
    stamp = json.loads((tmp_path / STAMP_NAME).read_text(encoding="utf-8"))
    stamp["files"][name] = {"group": "result", "fingerprint": ""}
    (tmp_path / STAMP_NAME).write_text(json.dumps(stamp), encoding="utf-8")
    with pytest.raises(InputError, match="out of the folder"):
        read_stamp(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"format": 1}', "[" * 100_000, '{"format": 99}'])
def test_damaged_stamp_ends_in_our_own_error(text: str, tmp_path: Path) -> None:
    (tmp_path / STAMP_NAME).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=STAMP_NAME):
        put(tmp_path, a_txt="1")


# ---------------------------------------------------------------------- one at a time

HOLD = """
import sys, time
from pathlib import Path
from onthefly3r.files.owned import OwnedFolder
from onthefly3r.files.room import storage_errors
with OwnedFolder.claim(Path(sys.argv[1]), "run"):
    print("held", flush=True)
    time.sleep(60)
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    environ = {**os.environ, "PYTHONPATH": str(ROOT / "core")}
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True, env=environ
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_second_process_is_told_at_once_and_a_killed_ones_lock_is_taken_over(tmp_path: Path) -> None:
    put(tmp_path, a_txt="1")
    with hold(tmp_path) as process:
        began = time.monotonic()
        with pytest.raises(BusyError, match=rf"process {process.pid} on .*\(run, "):
            put(tmp_path, a_txt="2")
        assert time.monotonic() - began < 2.0
        process.kill()
    assert (tmp_path / LOCK_NAME).exists()
    put(tmp_path, a_txt="3")
    assert seen(tmp_path) == {"a.txt": "3"}


def test_same_process_cannot_claim_twice(tmp_path: Path) -> None:
    with OwnedFolder.claim(tmp_path, "run"), pytest.raises(BusyError), OwnedFolder.claim(tmp_path, "export"):
        pass


def test_lock_of_another_computer_is_respected_and_the_way_out_told(tmp_path: Path) -> None:
    put(tmp_path, a_txt="1")
    told = {"pid": 1, "host": "another-computer", "verb": "run", "since": "2026-01-01"}
    (tmp_path / LOCK_NAME).write_text(json.dumps(told), encoding="utf-8")
    with pytest.raises(BusyError, match=f"another-computer.*delete .*{LOCK_NAME}"):
        put(tmp_path, a_txt="2")
    (tmp_path / LOCK_NAME).unlink()
    put(tmp_path, a_txt="2")


# ---------------------------------------------------------------------- room and access


def test_full_disk_is_told_before_the_first_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=2**20))
    with pytest.raises(StorageError, match="1 MiB free"), OwnedFolder.claim(tmp_path / "out", "run", need_bytes=2**30):
        pass
    assert not (tmp_path / "out").exists()


@POSIX
@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(StorageError, match="cannot be written"):
            put(tmp_path / "out", a_txt="1")
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("name", ["onthefly3r.json", "work"])
def test_out_below_a_file_is_told(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("x", encoding="utf-8")
    with pytest.raises(OnTheFly3RError):
        put(tmp_path / name / "out", a_txt="1")


@POSIX
def test_limit_on_the_size_of_files_leaves_the_earlier_ones(tmp_path: Path) -> None:
    """As a full disk does: the write fails half-way through."""
    import resource

    put(tmp_path, a_txt="1")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with (
            pytest.raises(StorageError, match="no room"),
            OwnedFolder.claim(tmp_path, "test") as held,
            storage_errors(tmp_path),
            held.scratch() as made,
        ):
            write(made, a_txt="2" * 10_000)
            held.publish(made, "result")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert seen(tmp_path) == {"a.txt": "1"}
