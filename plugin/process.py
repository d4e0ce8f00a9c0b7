"""Other programs run from QGIS: a clean environment, their own process group, an end within two seconds.

Standard library only.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

POLL_S = 0.1
GRACE_S = 1.2  # between the polite and the final signal
TAIL_BYTES = 20_000

# QGIS, an activated environment and OSGeo4W set these for themselves; another interpreter is led astray by them.
LED_ASTRAY = (
    "PYTHONHOME",
    "PYTHONPATH",
    "PYTHONSTARTUP",
    "PYTHONEXECUTABLE",
    "__PYVENV_LAUNCHER__",
    "VIRTUAL_ENV",
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "DYLD_LIBRARY_PATH",
    "QT_PLUGIN_PATH",
)
LED_ASTRAY_BEGINNINGS = ("PROJ_", "GDAL_", "OGR_")


@dataclass(frozen=True)
class Ended:
    """How a program ended."""

    returncode: int
    cancelled: bool
    error_text: str  # the end of what it wrote to standard error


def clean_environ(environ: Mapping[str, str], python_path: Path | None = None) -> dict[str, str]:
    """Return variables for another interpreter, with `python_path` as its only extra place for modules."""
    clean = {
        name: value
        for name, value in environ.items()
        if name.upper() not in LED_ASTRAY and not name.upper().startswith(LED_ASTRAY_BEGINNINGS)
    }
    clean.update(PYTHONUTF8="1", PYTHONNOUSERSITE="1", PIP_DISABLE_PIP_VERSION_CHECK="1")
    if python_path is not None:
        clean["PYTHONPATH"] = str(python_path)
    return clean


def stream(
    command: Sequence[str],
    environ: Mapping[str, str],
    on_line: Callable[[str], None],
    is_cancelled: Callable[[], bool],
) -> Ended:
    """Run a program to its end and hand over its lines as they come; raises `OSError` when it cannot be started.

    Cancelling ends the program and everything it started, within two seconds, whether or not it writes anything.
    """
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            list(command),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=dict(environ),
            **_own_group(),
        )
        lines: queue.Queue[str] = queue.Queue()
        reader = threading.Thread(target=_read_lines, args=(process.stdout, lines), daemon=True)
        reader.start()
        cancelled = False
        try:
            while process.poll() is None and not cancelled:
                time.sleep(POLL_S)
                _hand_over(lines, on_line)
                cancelled = is_cancelled()
        finally:
            end_group(process)
        reader.join(timeout=1.0)
        _hand_over(lines, on_line)
        return Ended(process.returncode, cancelled, _tail(errors))


def end_group(process: subprocess.Popen[bytes]) -> None:
    """End a program and all that it started: politely, then for good; no harm where it has ended already."""
    if os.name == "nt":
        if process.poll() is None:
            taskkill = Path(os.environ.get("SYSTEMROOT", r"C:\Windows"), "System32", "taskkill.exe")
            subprocess.run(
                [str(taskkill), "/T", "/F", "/PID", str(process.pid)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                check=False,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
    else:
        if process.poll() is None:
            _signal_group(process.pid, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(GRACE_S)
        # Children that ignored the first signal outlive their parent: the group is ended even when that is gone.
        _signal_group(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(5.0)


def _signal_group(leader: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, number)


def _own_group() -> dict[str, object]:
    if os.name == "nt":
        new_group = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
        return {"creationflags": new_group | getattr(subprocess, "CREATE_NO_WINDOW", 0)}
    return {"start_new_session": True}


def _read_lines(pipe, lines: queue.Queue[str]) -> None:
    with pipe:
        for line in pipe:
            lines.put(line.decode("utf-8", "replace").rstrip("\r\n"))


def _hand_over(lines: queue.Queue[str], on_line: Callable[[str], None]) -> None:
    with contextlib.suppress(queue.Empty):
        while True:
            on_line(lines.get_nowait())


def _tail(stream) -> str:
    stream.seek(0, os.SEEK_END)
    stream.seek(max(0, stream.tell() - TAIL_BYTES))
    return stream.read().decode("utf-8", "replace")
