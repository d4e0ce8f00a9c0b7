"""What Windows does otherwise, as far as it can be tested elsewhere: consoles, long paths, locked files."""

from __future__ import annotations

import ast
from pathlib import Path, PureWindowsPath

import pytest

from onthefly3r.errors import InputError
from onthefly3r.files import atomic, path_length
from onthefly3r.files.owned import OwnedFolder

ROOT = Path(__file__).resolve().parents[1]
STARTS = ("subprocess.run", "subprocess.Popen", "subprocess.check_output", "subprocess.check_call", "subprocess.call")
SOURCES = sorted(
    path
    for folder in ("plugin", "processing_algorithms", "core/onthefly3r", "bootstrap.py")
    for path in ((ROOT / folder).rglob("*.py") if (ROOT / folder).is_dir() else [ROOT / folder])
)
ONLY_ON_LINUX = {"ldd"}


def flashing(source: str) -> list[int]:
    """Lines where a program is started whose output is taken, and a console would flash up for it on Windows."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call) or ast.unparse(node.func) not in STARTS:
            continue
        named = {word.arg for word in node.keywords}  # None for **more
        inherits_console = not named & {"stdout", "capture_output", None}
        known = any(f"'{name}'" in ast.unparse(node) for name in ONLY_ON_LINUX)
        if not (inherits_console or known or named & {"creationflags", None}):
            lines.append(node.lineno)
    return lines


def test_no_console_flashes_up() -> None:
    starts = 0
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        starts += sum(text.count(f"{name}(") for name in STARTS)
        assert flashing(text) == [], path
    assert starts >= 6
    assert flashing("subprocess.run(['a'], capture_output=True)") == [1]


@pytest.mark.parametrize(
    ("folder", "allowed", "characters"),
    [
        (r"C:\surveys\quarry", False, 0),
        ("D:\\" + "a" * 179, False, 0),
        ("D:\\" + "a" * 180, False, 1),
        ("D:\\" + "a" * 240, False, 61),
        ("D:\\" + "a" * 240, True, 0),
        (r"\\server\share" + "\\" + "b" * 200, False, 33),
        ("\\\\?\\D:\\" + "a" * 240, False, 0),
    ],
)
def test_paths_that_windows_does_not_open_are_told(folder: str, allowed: bool, characters: int) -> None:
    told = path_length.too_long(PureWindowsPath(folder), allowed)
    assert (f"{characters} characters too long" in told) if characters else told == ""


def test_longest_name_is_one_that_is_made() -> None:
    scratch = "work/attempt-" + "0" * 16
    part = "features/.onthefly3r-" + "0" * 16 + ".part.npz"
    assert len(path_length.LONGEST_NAME) == len(f"{scratch}/{part}")


def test_too_long_a_folder_is_refused_before_the_first_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / ("d" * 240)
    monkeypatch.setattr(path_length, "WINDOWS", True)
    monkeypatch.setattr(path_length, "allows_long_paths", lambda: False)
    with pytest.raises(InputError, match="characters too long for Windows"), OwnedFolder.claim(folder, "run"):
        pass
    assert not folder.exists()


class Locked:
    """A rename that another program stands in the way of for some tries."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, times: int) -> None:
        self.left, self.waited = times, 0.0
        self._replace = Path.replace
        monkeypatch.setattr(Path, "replace", lambda source, target: self.rename(source, target))
        monkeypatch.setattr(atomic.time, "sleep", self.sleep)

    def rename(self, source: Path, target: Path) -> Path:
        if self.left:
            self.left -= 1
            raise PermissionError(13, "The process cannot access the file", str(source), 32, str(target))
        return self._replace(source, target)

    def sleep(self, seconds: float) -> None:
        self.waited += seconds


def test_file_that_is_locked_for_a_moment_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic, "WINDOWS", True)
    monkeypatch.setattr(atomic, "sync_file", lambda path: None)
    target = tmp_path / "report.json"
    target.write_text("old")
    locked = Locked(monkeypatch, 4)
    atomic.write_text(target, "new")
    assert target.read_text() == "new" and [path.name for path in tmp_path.iterdir()] == ["report.json"]
    assert 0.0 < locked.waited < 2.0


def test_file_that_stays_locked_is_told_and_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic, "WINDOWS", True)
    target = tmp_path / "report.json"
    target.write_text("old")
    locked = Locked(monkeypatch, 99)
    with pytest.raises(PermissionError):
        atomic.write_text(target, "new")
    assert target.read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["report.json"]
    assert 2.0 < locked.waited < 4.0


def test_elsewhere_nothing_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if atomic.WINDOWS:
        pytest.skip("of other systems")
    locked = Locked(monkeypatch, 1)
    with pytest.raises(PermissionError):
        atomic.write_text(tmp_path / "report.json", "new")
    assert locked.waited == 0.0
