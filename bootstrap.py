"""Set up On-the-Fly3R in an environment of its own beside this file, and run it there.

    python3 bootstrap.py setup [--environment FOLDER] [--extra NAME]
                                                      make FOLDER or .venv and install the package
    python3 bootstrap.py demo [OUT]                   render a small survey and reconstruct it
    python3 bootstrap.py run PHOTOS OUT [options...]  reconstruct a folder of photographs
    python3 bootstrap.py test [pytest arguments...]   lint, types and tests, those of QGIS too where it is installed
    python3 bootstrap.py test --quick                 lint, types and the fast tests, with the base installation only
    python3 bootstrap.py lint                         lint and types
    python3 bootstrap.py package [--publish]          write the zip of the QGIS plugin; one to hand in

Standard library only, Linux, macOS and Windows, no administrator rights. Other programs may import this
module and call `create_environment`.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
STAMP_NAME = "onthefly3r-stamp.json"  # in an environment that is complete
MARK_NAME = "onthefly3r-environment.txt"  # in one that we made, complete or not
OLDEST_PYTHON = (3, 10)
QGIS_PYTHON = "ONTHEFLY3R_QGIS_PYTHON"  # variable that names an interpreter with QGIS, for the tests
QGIS_PACKAGES = ("qgis", "python3-qgis", "qgis-providers", "python3-pytest", "xvfb")
TEST_EXTRAS = ("cloud", "neural", "test")
QUICK_EXTRAS = ("test",)

# Room that an installation needs while it is under way, in MiB: wheels, their unpacked files and pip's copies.
BASE_NEED_MIB = 1200
EXTRA_NEED_MIB = {"neural": 6000, "cloud": 1200, "test": 200}

# The tests need only a processor: 2.13.0 is the release whose processor-only build they are run with, which
# saves the gigabytes of GPU libraries where the index offers that build.
TEST_CONSTRAINTS = "torch==2.13.0\n"

# A model whose adapter is tested on its own code. What it names as dependencies contradicts ours (numpy below 2);
# what its network really needs is in the extra `test`.
TEST_MODELS = ('depth-anything-3==0.1.1; python_version < "3.13"',)

# On Windows the public index has torch for the processor only; the builds for NVIDIA GPUs are at its makers' own.
TORCH_GPU_INDEX = "https://download.pytorch.org/whl/cu126"

NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # of Windows: no console flashes up

Report = Callable[[str], None]


class SetupError(Exception):
    """The environment cannot be made; the message says how to mend it."""


def without_builds(system: str, machine: str) -> str:
    """Return what to do where a package that the work needs has no build, empty where all are to be had.

    `system` and `machine` are those of the module `platform`; README's table of platforms says the same.
    """
    machine = machine.lower()
    if (system, machine) == ("Darwin", "x86_64"):
        remedy = "use a Mac with Apple silicon, Windows or Linux on x86_64"
    elif system == "Linux" and machine not in ("x86_64", "amd64"):
        remedy = "use Linux on x86_64"
    elif system == "Windows" and machine not in ("x86_64", "amd64"):
        remedy = "use a Python for x86_64, which Windows on ARM runs too"
    else:
        return ""
    return (
        f"pycolmap has no ready build for {system} on {machine}, and reconstruction requires it: {remedy}, "
        "or build pycolmap from its source into the environment."
    )


def say(message: str) -> None:
    """Print a line at once, whatever the console's encoding."""
    encoding = sys.stdout.encoding or "utf-8"
    print(message.encode(encoding, "replace").decode(encoding), flush=True)


def environment_python(folder: Path) -> Path:
    """Return the interpreter of the environment in `folder`."""
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def clean_environ() -> dict[str, str]:
    """Return this process's variables without those that lead another interpreter astray."""
    led_astray = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "__PYVENV_LAUNCHER__", "VIRTUAL_ENV")
    environ = {name: value for name, value in os.environ.items() if name not in led_astray}
    environ.update(PYTHONUTF8="1", PYTHONNOUSERSITE="1", PIP_DISABLE_PIP_VERSION_CHECK="1")
    return environ


def create_environment(
    folder: Path,
    extras: Iterable[str] = (),
    progress: Report = say,
    *,
    source: Path = ROOT,
    constraints: str = "",
    alone: Iterable[str] = (),
) -> Path:
    """Make the environment in `folder`, install the package of `source` with `extras`, return its interpreter.

    Returns at once when a stamp in the folder says that this was done already; extras add up. `constraints` are
    lines of a pip constraints file; `alone` are requirements that come without what they depend on. A folder that
    holds anything else than an environment of ours is left alone. Raises `SetupError` with the remedy.
    """
    folder = Path(folder).absolute()
    python = environment_python(folder)
    wanted, lone = set(extras), set(alone)
    installed = _read_stamp(folder)
    package = _package_hash(source)
    # An environment stays usable while its own interpreter is the one that it was made with.
    if installed and installed.get("interpreter") == _version_of(python):
        lone_there = set(installed.get("alone", ()))
        if installed.get("package") == package and wanted <= set(installed["extras"]) and lone <= lone_there:
            return python
        wanted, lone = wanted | set(installed["extras"]), lone | lone_there
    else:
        _claim(folder, bool(installed))
        _make_venv(folder, progress)
    _check_room(folder, wanted)
    (folder / STAMP_NAME).unlink(missing_ok=True)
    named = f"[{','.join(sorted(wanted))}]" if wanted else ""
    if torch_index(platform.system(), wanted, has_nvidia_gpu):
        _install_gpu_torch(python, constraints, progress)
    progress(f"Installing onthefly3r{named} into {folder}; the first time takes some minutes.")
    _pip_install(python, ["-e", f"{source}{named}"], constraints, progress)
    for requirement in sorted(lone):
        _pip_install(python, ["--no-deps", requirement], constraints, progress)
    stamp = {
        "interpreter": _version_of(python),
        "package": package,
        "extras": sorted(wanted),
        "alone": sorted(lone),
    }
    (folder / STAMP_NAME).write_text(json.dumps(stamp, indent=1), encoding="utf-8")
    return python


def _ask(
    command: Sequence[str], environ: Mapping[str, str], timeout_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command without a window and return what it wrote, whatever the code page of the console."""
    return subprocess.run(
        list(command),
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
        env=dict(environ),
        stdin=subprocess.DEVNULL,
        timeout=timeout_s,
        creationflags=NO_WINDOW,
    )


def has_nvidia_gpu() -> bool:
    """Return whether nvidia-smi is there, works, and lists a GPU."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return False
    try:
        listing = _ask([tool, "-L"], os.environ, timeout_s=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return listing.returncode == 0 and "GPU" in listing.stdout


def _read_stamp(folder: Path) -> dict[str, Any]:
    try:
        stamp = json.loads((folder / STAMP_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) and isinstance(stamp.get("extras"), list) else {}


def _version_of(python: Path) -> str:
    """Return an interpreter's version, empty when it does not run."""
    command = [str(python), "-c", "import platform; print(platform.python_version())"]
    try:
        ran = _ask(command, clean_environ())
    except OSError:
        return ""
    return ran.stdout.strip() if ran.returncode == 0 else ""


def _package_hash(source: Path) -> str:
    """Return a hash of the requirements and of the place that an editable installation points to."""
    return hashlib.sha256((source / "pyproject.toml").read_bytes() + str(source).encode()).hexdigest()


def _claim(folder: Path, stamped: bool) -> None:
    """Empty a folder that is ours for a new environment; raises `SetupError` for one that holds anything else."""
    mark = folder / MARK_NAME
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise SetupError(f"{folder} is a file or a link: name a folder that is empty or not there yet.")
    if folder.is_dir() and any(folder.iterdir()) and not (stamped or mark.is_file()):
        raise SetupError(
            f"{folder} is not empty, and no environment that this program made: nothing in it was changed. "
            f"Name an empty folder, for instance {folder / 'onthefly3r'}, or delete this one yourself."
        )
    folder.mkdir(parents=True, exist_ok=True)
    mark.write_text("An environment of On-the-Fly3R: 'bootstrap.py setup' replaces all that is here.\n", "utf-8")
    for item in folder.iterdir():
        if item == mark:
            continue
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item)
        else:
            item.unlink()


def _make_venv(folder: Path, progress: Report) -> None:
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise SetupError(
            f"This Python ({sys.executable}) lacks the venv or ensurepip module.\n"
            f"On Debian and Ubuntu install it with: sudo apt-get install python3-venv\n"
            f"(or python{version}-venv), then run this command again."
        )
    progress(f"Making the environment {folder}")
    made = _ask([sys.executable, "-m", "venv", str(folder)], clean_environ())
    if made.returncode != 0:
        told = (made.stdout + made.stderr).strip()
        remedy = " (on Debian and Ubuntu: sudo apt-get install python3-venv)" if "ensurepip" in told else ""
        raise SetupError(f"The environment {folder} could not be made{remedy}:\n{told}")


def _check_room(folder: Path, extras: Iterable[str]) -> None:
    """Refuse to start what the disk cannot hold; torch with GPU libraries is counted only where there is a GPU."""
    need = BASE_NEED_MIB + sum(EXTRA_NEED_MIB.get(extra, 0) for extra in extras)
    free = shutil.disk_usage(folder).free // 2**20
    if free < need:
        raise SetupError(f"{folder} has {free} MiB free, and the installation needs about {need} MiB: make room.")


def _pip_install(python: Path, wanted: Sequence[str], constraints: str, progress: Report) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        command = [str(python), "-m", "pip", "install", "--progress-bar", "off", "--no-input", *wanted]
        if constraints:
            constraint_file = Path(scratch) / "constraints.txt"
            constraint_file.write_text(constraints, encoding="utf-8")
            command += ["-c", str(constraint_file)]
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            encoding="utf-8",
            errors="replace",
            env=clean_environ(),
            creationflags=NO_WINDOW,
        )
        told: list[str] = []
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                told.append(line.rstrip())
                if line.startswith(("Collecting", "Installing")) or line.lstrip().startswith("Downloading"):
                    progress(f"  {line.strip()[:110]}")
        if process.wait() != 0:
            raise SetupError(explain_pip_failure("\n".join(told[-60:])))


def torch_index(system: str, extras: Iterable[str], has_gpu: Callable[[], bool]) -> str:
    """Return the index that torch with GPU support comes from, empty where the public index has it or none is wanted.

    `system` is that of the module `platform`.
    """
    return TORCH_GPU_INDEX if system == "Windows" and "neural" in set(extras) and has_gpu() else ""


def _install_gpu_torch(python: Path, constraints: str, progress: Report) -> None:
    """Install torch for the GPU first, so that the package finds it there; without it, the processor's will do."""
    progress(f"Installing torch for the GPU from {TORCH_GPU_INDEX}")
    try:
        _pip_install(python, ["torch", "--index-url", TORCH_GPU_INDEX], constraints, progress)
    except SetupError as error:
        progress(f"{error}\nGoing on with torch for the processor; neural backbones will be slow.")


def explain_pip_failure(told: str) -> str:
    """Return what pip's output means and how to mend it."""
    # setuptools is asked for first, and runs everywhere: an index that has none of it was not reached.
    unreachable = (
        "satisfies the requirement setuptools",
        "NewConnectionError",
        "ConnectTimeoutError",
        "name resolution",
        "ProxyError",
        "getaddrinfo",
    )
    if any(sign in told for sign in unreachable):
        meaning = (
            "The package index cannot be reached. Connect this machine to the network, or tell pip a proxy "
            "(variable HTTPS_PROXY) or a folder of wheels (variable PIP_FIND_LINKS), and run the command again."
        )
    elif "No space left" in told:
        meaning = "The disk is full. Make room (several GiB) and run the command again."
    elif "No matching distribution" in told:
        meaning = (
            "A package has no build for this interpreter and system: "
            "use a 64-bit Python 3.10 to 3.14; pip's words are above."
        )
    else:
        meaning = "pip could not install the package; its words are above."
    return f"{told.strip()}\n{meaning}"  # last, where people look


def _call(command: Sequence[str | Path], **variables: str) -> int:
    """Run a command to its end and return its exit status; Ctrl-C is left to the command to handle."""
    with subprocess.Popen([str(part) for part in command], env={**clean_environ(), **variables}) as process:
        while True:
            with contextlib.suppress(KeyboardInterrupt):
                return process.wait()


def missing_system_libraries(python: Path) -> list[str]:
    """Return one sentence for each package of the environment that a system library is missing for."""
    told = _ask([str(python), "-m", "onthefly3r", "doctor", "--json"], clean_environ()).stdout
    try:
        checks = json.loads(told)["checks"]
    except (ValueError, KeyError, TypeError):
        return []
    return [f"{check['name']}: {check['remedy']}" for check in checks if check.get("missing_libraries")]


def find_qgis() -> tuple[str, str]:
    """Return an interpreter that has QGIS and pytest, or an empty text and why the tests of QGIS are left out."""
    missing = ""
    for candidate in dict.fromkeys(
        (os.environ.get(QGIS_PYTHON, ""), "/usr/bin/python3", shutil.which("python3") or "")
    ):
        if not candidate or not Path(candidate).is_file():
            continue
        lacking = [module for module in ("qgis.core", "pytest") if not _can_import(candidate, module)]
        if not lacking:
            return candidate, ""
        missing = missing or f"{candidate} lacks {' and '.join(lacking)}"
    return "", (
        f"{missing or 'no interpreter was found'}; on Debian and Ubuntu: sudo apt-get install --no-install-recommends "
        f"{' '.join(QGIS_PACKAGES)} (or name an interpreter in {QGIS_PYTHON})"
    )


def _can_import(python: str, module: str) -> bool:
    command = [python, "-c", f"import {module}"]
    environ = {**clean_environ(), "QT_QPA_PLATFORM": "offscreen"}
    return _ask(command, environ).returncode == 0


def setup(environment: Path, rest: Sequence[str] = ()) -> int:
    """Make the environment, with torch where an NVIDIA GPU is found and the folder is not named."""
    parser = argparse.ArgumentParser(prog="bootstrap.py setup")
    parser.add_argument("--environment", type=Path, help="folder of the environment (default: .venv)")
    parser.add_argument("--extra", action="append", choices=("neural", "cloud"), default=[], help="packages to add")
    chosen = parser.parse_args(rest)
    extras = chosen.extra or (["neural"] if chosen.environment is None and has_nvidia_gpu() else [])
    python = create_environment(chosen.environment or environment, extras)
    say(f"Ready. Interpreter: {python}")
    return 0


def demo(environment: Path, out: Path, rest: Sequence[str]) -> int:
    """Render a small survey, reconstruct it and compare with the truth."""
    return _call([create_environment(environment), "-m", "onthefly3r", "demo", out, *rest])


def run(environment: Path, rest: Sequence[str]) -> int:
    """Hand everything to the command line's `run`."""
    return _call([create_environment(environment), "-m", "onthefly3r", "run", *rest])


def lint(environment: Path) -> int:
    """Check style and types, and return 0 only when both are clean."""
    return 0 if all(_checked(_lint_checks(create_environment(environment, QUICK_EXTRAS))).values()) else 1


def _lint_checks(python: Path) -> dict[str, list[str | Path]]:
    return {
        "ruff check": [python, "-m", "ruff", "check", ROOT],
        "ruff format": [python, "-m", "ruff", "format", "--check", ROOT],
        "mypy": [python, "-m", "mypy", "--config-file", ROOT / "pyproject.toml"],
    }


def _checked(checks: Mapping[str, Sequence[str | Path]]) -> dict[str, bool]:
    """Run each check to its end; return whether it passed, by name."""
    passed = {}
    for name, command in checks.items():
        say(f"== {name}")
        passed[name] = _call(command) == 0
    return passed


def test(environment: Path, rest: Sequence[str]) -> int:
    """Run every check to its end, and return 0 only when all passed."""
    quick = "--quick" in rest
    rest = [word for word in rest if word != "--quick"]
    if quick:
        python = create_environment(environment, QUICK_EXTRAS)
        rest = ["-m", "not slow and not photographs", *rest]
    else:
        python = create_environment(environment, TEST_EXTRAS, constraints=TEST_CONSTRAINTS, alone=TEST_MODELS)
    for sentence in missing_system_libraries(python):
        say(f"Tests that need it will be skipped: {sentence}")
    pytest: list[str | Path] = [python, "-m", "pytest", "--rootdir", ROOT, "-c", ROOT / "pyproject.toml", *rest]
    passed = _checked({**_lint_checks(python), "pytest": pytest})
    left_out = "the quick run has none" if quick else "pytest was given arguments" if rest else ""
    if not left_out:
        qgis_python, left_out = find_qgis()
    if not left_out:
        say("== tests of QGIS")
        tests = ROOT / "tests" / "qgis"
        command: list[str | Path] = [qgis_python, "-m", "pytest", "-c", tests / "pytest.ini", "--rootdir", tests, tests]
        status = _call(command, ONTHEFLY3R_PYTHON=str(python), QT_QPA_PLATFORM="offscreen")
        passed["tests of QGIS"] = status == 0
    failed = [name for name, good in passed.items() if not good]
    if left_out:
        say(f"Left out: tests of QGIS ({left_out})")
    say(f"Failed: {', '.join(failed)}" if failed else "All checks passed: " + ", ".join(passed))
    return 1 if failed else 0


def package(rest: Sequence[str] = ()) -> int:
    """Write the zip of the QGIS plugin into `dist`."""
    return _call([sys.executable, ROOT / "tools" / "package_plugin.py", *rest])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit status: the verb's own, 2 when the environment cannot be made."""
    parser = argparse.ArgumentParser(
        prog="bootstrap.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=("setup", "demo", "run", "test", "lint", "package"))
    parser.add_argument("rest", nargs=argparse.REMAINDER, help="what the verb takes")
    chosen = parser.parse_args(arguments)
    if sys.version_info < OLDEST_PYTHON:
        say(f"Python {OLDEST_PYTHON[0]}.{OLDEST_PYTHON[1]} or newer is needed; this is {platform.python_version()}.")
        return 2
    environment = ROOT / ".venv"
    if chosen.verb != "package" and (warning := without_builds(platform.system(), platform.machine())):
        say(warning)
    try:
        if chosen.verb == "setup":
            return setup(environment, chosen.rest)
        if chosen.verb == "package":
            return package(chosen.rest)
        if chosen.verb == "demo":
            named = bool(chosen.rest) and not chosen.rest[0].startswith("-")
            out = Path(chosen.rest.pop(0)) if named else Path("demo-survey")
            return demo(environment, out, chosen.rest)
        if chosen.verb == "run":
            return run(environment, chosen.rest)
        if chosen.verb == "lint":
            return lint(environment)
        return test(environment, chosen.rest)
    except SetupError as error:
        say(str(error))
        return 2
    except KeyboardInterrupt:
        say("Stopped.")
        return 128 + signal.SIGINT


if __name__ == "__main__":
    raise SystemExit(main())
