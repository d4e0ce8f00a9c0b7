"""The set-up script without installing anything: stamps, remedies, exit codes; venv and pip are stood in for."""

from __future__ import annotations

import importlib.util
import json
import platform
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def bootstrap() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bootstrap_under_test", ROOT / "bootstrap.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "a source with späces"
    folder.mkdir()
    (folder / "pyproject.toml").write_text("[project]\nname = 'x'\n", encoding="utf-8")
    return folder


class Installer:
    """Stands in for venv and pip, and counts what was asked of them."""

    def __init__(self, bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
        self.venvs = 0
        self.requirements: list[str] = []
        self.constraints: list[str] = []
        self.python = bootstrap.environment_python
        monkeypatch.setattr(bootstrap, "_make_venv", self.make_venv)
        monkeypatch.setattr(bootstrap, "_pip_install", self.install)
        monkeypatch.setattr(bootstrap, "_version_of", lambda python: "3.11.2" if python.exists() else "")

    def make_venv(self, folder: Path, progress: Any) -> None:
        self.venvs += 1
        self.python(folder).parent.mkdir(parents=True, exist_ok=True)
        self.python(folder).touch()

    def install(self, python: Path, wanted: Sequence[str], constraints: str, progress: Any) -> None:
        assert wanted[0] in ("-e", "--no-deps")
        self.requirements.append(wanted[-1] if wanted[0] == "-e" else " ".join(wanted))
        self.constraints.append(constraints)


@pytest.fixture
def installer(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Installer:
    return Installer(bootstrap, monkeypatch)


def test_second_call_does_nothing(bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path) -> None:
    folder = tmp_path / "ümgebung"
    for _ in range(2):
        python = bootstrap.create_environment(folder, (), source=source)
        assert python == bootstrap.environment_python(folder)
    assert (installer.venvs, installer.requirements) == (1, [str(source)])


def test_extras_add_up(bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path) -> None:
    folder = tmp_path / "environment"
    for extras in ((), ("test",), ("cloud",), ("test",), ("test", "cloud")):
        bootstrap.create_environment(folder, extras, source=source)
    assert installer.venvs == 1
    assert installer.requirements == [str(source), f"{source}[test]", f"{source}[cloud,test]"]


def test_what_comes_without_its_dependencies(
    bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "environment"
    bootstrap.create_environment(folder, ("test",), source=source)
    for _ in range(2):
        bootstrap.create_environment(folder, ("test",), source=source, constraints="torch==1\n", alone=("model==2",))
    bootstrap.create_environment(folder, ("cloud",), source=source)
    assert installer.requirements == [
        f"{source}[test]",
        f"{source}[test]",
        "--no-deps model==2",
        f"{source}[cloud,test]",
        "--no-deps model==2",
    ]
    assert installer.constraints[1:3] == ["torch==1\n"] * 2  # no build of torch but the tested one


def test_changed_requirements_are_installed_into_the_same_environment(
    bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "environment"
    bootstrap.create_environment(folder, ("test",), source=source)
    (source / "pyproject.toml").write_text("[project]\nname = 'y'\n", encoding="utf-8")
    bootstrap.create_environment(folder, (), source=source)
    assert (installer.venvs, installer.requirements) == (1, [f"{source}[test]"] * 2)


@pytest.mark.parametrize("version", ["3.12.1", ""], ids=["upgraded", "does not run"])
def test_environment_whose_interpreter_changed_is_made_anew(
    version: str,
    bootstrap: ModuleType,
    installer: Installer,
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "environment"
    bootstrap.create_environment(folder, ("test",), source=source)
    monkeypatch.setattr(bootstrap, "_version_of", lambda python: version)
    bootstrap.create_environment(folder, (), source=source)
    assert (installer.venvs, installer.requirements) == (2, [f"{source}[test]", str(source)])


def test_version_is_asked_of_the_interpreter_itself(bootstrap: ModuleType, tmp_path: Path) -> None:
    assert bootstrap._version_of(Path(sys.executable)) == platform.python_version()
    assert bootstrap._version_of(tmp_path / "python") == ""


def test_failed_installation_leaves_no_stamp(
    bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> None:
        raise bootstrap.SetupError("no network")

    folder = tmp_path / "environment"
    bootstrap.create_environment(folder, (), source=source)
    with monkeypatch.context() as patch:
        patch.setattr(bootstrap, "_pip_install", fail)
        with pytest.raises(bootstrap.SetupError, match="no network"):
            bootstrap.create_environment(folder, ("test",), source=source)
    bootstrap.create_environment(folder, (), source=source)
    assert len(installer.requirements) == 2


def test_damaged_stamp_is_no_stamp(bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path) -> None:
    folder = tmp_path / "environment"
    for damage in ("", "{", "[]", json.dumps({"extras": 3})):
        bootstrap.create_environment(folder, (), source=source)
        (folder / bootstrap.STAMP_NAME).write_text(damage, encoding="utf-8")
    assert installer.venvs == 4


def test_short_disk_is_told_before_anything_is_installed(
    bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bootstrap.shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 100 * 2**20})())
    with pytest.raises(bootstrap.SetupError, match="100 MiB free"):
        bootstrap.create_environment(tmp_path / "environment", (), source=source)
    assert not installer.requirements


def test_missing_venv_module_names_the_package(
    bootstrap: ModuleType, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bootstrap.importlib.util, "find_spec", lambda name: None if name == "ensurepip" else object())
    with pytest.raises(bootstrap.SetupError, match="apt-get install python3-venv"):
        bootstrap.create_environment(tmp_path / "environment", (), source=source)


@pytest.mark.parametrize(
    ("told", "meaning"),
    [
        ("WARNING: Retrying ... NewConnectionError('...: Temporary failure in name resolution')", "cannot be reached"),
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "disk is full"),
        ("ERROR: No matching distribution found for gtsam>=4.2.1", "no build for this interpreter"),
        ("error: subprocess-exited-with-error", "its words are above"),
    ],
)
def test_failure_of_pip_is_explained(bootstrap: ModuleType, told: str, meaning: str) -> None:
    explained = bootstrap.explain_pip_failure(told)
    assert meaning in explained
    assert told in explained


def test_unreachable_index_is_told_by_the_real_pip(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", "")
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    if importlib.util.find_spec("pip") is None:
        pytest.skip("this interpreter has no pip")
    with pytest.raises(bootstrap.SetupError, match="cannot be reached"):
        bootstrap._pip_install(Path(sys.executable), ["-e", str(ROOT)], "", lambda line: None)


@pytest.mark.parametrize(("listing", "status", "found"), [("GPU 0: some", 0, True), ("", 0, False), ("GPU", 9, False)])
def test_gpu_is_believed_only_when_its_tool_works(
    listing: str, status: int, found: bool, bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bootstrap.shutil, "which", lambda name: "nvidia-smi")
    answer = subprocess.CompletedProcess([], status, stdout=listing, stderr="")
    monkeypatch.setattr(bootstrap.subprocess, "run", lambda *arguments, **named: answer)
    assert bootstrap.has_nvidia_gpu() is found


def test_variables_that_lead_astray_do_not_reach_the_environment(
    bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    monkeypatch.setenv("PYTHONHOME", "elsewhere")
    environ = bootstrap.clean_environ()
    assert not {"PYTHONPATH", "PYTHONHOME"} & set(environ)
    assert environ["PYTHONUTF8"] == "1"


@pytest.fixture
def calls(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    made: list[list[str]] = []

    def call(command: Sequence[Any], **variables: str) -> int:
        made.append([str(part) for part in command])
        return 5 if "mypy" in made[-1] else 0

    monkeypatch.setattr(bootstrap, "_call", call)
    monkeypatch.setattr(bootstrap, "create_environment", lambda *arguments, **named: Path("python"))
    monkeypatch.setattr(bootstrap, "missing_system_libraries", lambda python: [])
    return made


def test_run_hands_everything_over(bootstrap: ModuleType, calls: list[list[str]]) -> None:
    assert bootstrap.main(["run", "my photographs", "out", "--seed-size", "12", "--json"]) == 0
    assert calls == [
        ["python", "-m", "onthefly3r", "run", "my photographs", "out", "--seed-size", "12", "--json"],
    ]


@pytest.mark.parametrize(
    ("given", "expected"),
    [([], ["demo-survey"]), (["elsewhere"], ["elsewhere"]), (["--json"], ["demo-survey", "--json"])],
)
def test_demo_has_a_default_folder(
    given: list[str], expected: list[str], bootstrap: ModuleType, calls: list[list[str]]
) -> None:
    assert bootstrap.main(["demo", *given]) == 0
    assert calls == [["python", "-m", "onthefly3r", "demo", *expected]]


def test_every_check_runs_and_one_failure_fails(
    bootstrap: ModuleType, calls: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert bootstrap.main(["test", "-k", "options"]) == 1
    assert [command[2] for command in calls] == ["ruff", "ruff", "mypy", "pytest"]  # QGIS is left out with arguments
    assert calls[-1][-2:] == ["-k", "options"]
    assert capsys.readouterr().out.strip().endswith("Failed: mypy")


def test_quick_run_leaves_out_what_is_slow_and_takes_the_base_installation(
    bootstrap: ModuleType, calls: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(bootstrap, "create_environment", lambda *given, **named: asked.append(given) or Path("python"))
    bootstrap.main(["test", "--quick", "-x"])
    assert calls[-1][-3:] == ["-m", "not slow and not photographs", "-x"]
    assert asked[0][1] == ("test",)


def test_lint_is_a_part_of_it(bootstrap: ModuleType, calls: list[list[str]]) -> None:
    assert bootstrap.main(["lint"]) == 1  # mypy fails here
    assert [command[2] for command in calls] == ["ruff", "ruff", "mypy"]


def test_qgis_is_tested_where_it_is_found(
    bootstrap: ModuleType, calls: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bootstrap, "_can_import", lambda python, module: True)
    monkeypatch.setenv("ONTHEFLY3R_QGIS_PYTHON", sys.executable)
    bootstrap.main(["test"])
    assert calls[-1][:3] == [sys.executable, "-m", "pytest"]
    assert calls[-1][-1] == str(ROOT / "tests" / "qgis")
    assert "Left out" not in capsys.readouterr().out


def test_qgis_that_is_missing_is_told(
    bootstrap: ModuleType, calls: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bootstrap, "_can_import", lambda python, module: module == "pytest")
    monkeypatch.setenv("ONTHEFLY3R_QGIS_PYTHON", sys.executable)
    bootstrap.main(["test"])
    assert len(calls) == 4
    told = capsys.readouterr().out
    assert f"Left out: tests of QGIS ({sys.executable} lacks qgis.core; on Debian" in told
    assert "apt-get install --no-install-recommends qgis python3-qgis" in told


def test_import_is_tried_in_the_interpreter_itself(bootstrap: ModuleType) -> None:
    assert bootstrap._can_import(sys.executable, "json")
    assert not bootstrap._can_import(sys.executable, "no_such_module")


def test_packages_for_qgis_are_those_that_ci_installs(bootstrap: ModuleType) -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert f"qgis=({' '.join(bootstrap.QGIS_PACKAGES)})" in script


def test_trouble_with_the_environment_is_one_message(
    bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*arguments: Any, **named: Any) -> None:
        raise bootstrap.SetupError("make room")

    monkeypatch.setattr(bootstrap, "create_environment", fail)
    assert bootstrap.main(["setup"]) == 2
    assert capsys.readouterr().out == "make room\n"


def test_missing_libraries_come_from_doctor(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = [
        {"name": "open3d", "remedy": "sudo apt-get install libgl1", "missing_libraries": ["libGL.so.1"]},
        {"name": "torch", "remedy": "pip install torch", "missing_libraries": []},
    ]
    answer = subprocess.CompletedProcess([], 0, stdout=json.dumps({"checks": checks}), stderr="")
    monkeypatch.setattr(bootstrap.subprocess, "run", lambda *arguments, **named: answer)
    assert bootstrap.missing_system_libraries(Path("python")) == ["open3d: sudo apt-get install libgl1"]


@pytest.mark.parametrize(
    ("system", "machine", "told"),
    [
        ("Windows", "AMD64", ""),
        ("Linux", "x86_64", ""),
        ("Darwin", "arm64", ""),
        ("Darwin", "x86_64", "Apple silicon"),
        ("Linux", "aarch64", "Linux on x86_64"),
        ("Windows", "ARM64", "Python for x86_64"),
    ],
)
def test_the_first_line_says_what_cannot_be_had(
    system: str,
    machine: str,
    told: str,
    bootstrap: ModuleType,
    calls: list[list[str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(bootstrap.platform, "system", lambda: system)
    monkeypatch.setattr(bootstrap.platform, "machine", lambda: machine)
    bootstrap.main(["run", "photographs", "out"])
    first = capsys.readouterr().out.partition("\n")[0]
    assert told in first
    assert ("pycolmap" in first) == bool(told)


def test_script_needs_only_the_standard_library() -> None:
    script = (
        "import sys\nbefore = set(sys.modules)\nimport bootstrap\n"
        "print(*{name.split('.')[0] for name in set(sys.modules) - before})"
    )
    ran = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{script}"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(ran.stdout.split()) - set(sys.stdlib_module_names) == {"bootstrap"}


@pytest.mark.parametrize("name", ["thesis.txt", "pyvenv.cfg"])
def test_folder_of_somebody_else_is_no_place_for_an_environment(
    name: str, bootstrap: ModuleType, tmp_path: Path
) -> None:
    (tmp_path / name).write_text("precious", encoding="utf-8")
    with pytest.raises(bootstrap.SetupError, match="is not empty"):
        bootstrap.create_environment(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_environment_that_was_cut_short_is_made_anew(bootstrap: ModuleType, tmp_path: Path) -> None:
    """Nothing but the mark says that it is ours until it is complete."""
    bootstrap._claim(tmp_path, stamped=False)
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "half.py").touch()
    bootstrap._claim(tmp_path, stamped=False)
    assert [path.name for path in tmp_path.iterdir()] == [bootstrap.MARK_NAME]


@pytest.mark.parametrize(
    ("system", "extras", "gpu", "asked"),
    [
        ("Windows", ["neural"], True, True),
        ("Windows", ["neural"], False, False),
        ("Windows", ["cloud"], True, False),
        ("Linux", ["neural"], True, False),
        ("Darwin", ["neural"], True, False),
    ],
)
def test_torch_for_the_gpu_has_an_index_of_its_own_on_windows(
    bootstrap: ModuleType, system: str, extras: list[str], gpu: bool, asked: bool
) -> None:
    index = bootstrap.torch_index(system, extras, lambda: gpu)
    assert index == (bootstrap.TORCH_GPU_INDEX if asked else "")


def test_torch_for_the_gpu_comes_first_and_may_fail(
    bootstrap: ModuleType, installer: Installer, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def install(python: Path, wanted: Sequence[str], constraints: str, progress: Any) -> None:
        asked.append(list(wanted))
        if "--index-url" in wanted:
            raise bootstrap.SetupError("The package index cannot be reached.")

    monkeypatch.setattr(bootstrap, "_pip_install", install)
    monkeypatch.setattr(bootstrap.platform, "system", lambda: "Windows")
    monkeypatch.setattr(bootstrap, "has_nvidia_gpu", lambda: True)
    told: list[str] = []
    bootstrap.create_environment(tmp_path / "env", ["neural"], told.append, source=source)
    assert [words[0] for words in asked] == ["torch", "-e"]
    assert any("cannot be reached" in line and "processor" in line for line in told)


def test_environment_of_windows_has_its_interpreter_elsewhere(
    bootstrap: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(bootstrap.os, "name", "nt")
        python = bootstrap.environment_python(tmp_path)
    assert python.relative_to(tmp_path).as_posix() == "Scripts/python.exe"


def test_answers_in_another_code_page_are_read(bootstrap: ModuleType) -> None:
    script = "import sys; sys.stdout.buffer.write(bytes(range(128, 256)))"
    assert len(bootstrap._ask([sys.executable, "-c", script], {}).stdout) > 10


def test_output_that_the_console_cannot_show_is_no_error(
    bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    import io

    console = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", console)
    bootstrap.say("Vermessung ü 測量")
    console.flush()
    assert console.buffer.getvalue().decode("cp1252").strip() == "Vermessung ü ??"
