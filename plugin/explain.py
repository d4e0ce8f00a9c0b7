"""Plain sentences for whatever ends a worker, and a text to hand on when somebody is asked for help.

Standard library only.
"""

from __future__ import annotations

import platform
import re
import signal
import sys
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone

SETUP = "run 'Set up processing environment' in the toolbox (On-the-Fly3R)"

NO_INTERPRETER = (
    "On-the-Fly3R has no environment to compute in yet: "
    f"{SETUP}, or name an existing Python under Settings > Options > Processing > Providers > On-the-Fly3R."
)
MEMORY = (
    "Most likely the memory did not suffice: choose the quality 'preview', lower 'working_px' or 'dense_px', "
    "close other programs, or use a computer with more memory."
)
# Statuses of Windows for a process that did not end by itself.
ACCESS_VIOLATION = 0xC0000005
MISSING_LIBRARY = 0xC0000135
WINDOWS_NO_MEMORY = (0xC0000017, 0xC000012D)


def explain(returncode: int, told: str | None, error_text: str) -> str:
    """Return why a worker ended, and the remedy.

    Args:
        returncode: as `subprocess` gives it; negative for a signal.
        told: the message of the worker's own error event, if it got to send one.
        error_text: the end of its standard error.
    """
    if told:
        return told
    code = returncode & 0xFFFFFFFF if returncode > 255 or returncode < -64 else returncode
    if code in (-getattr(signal, "SIGKILL", 9), 137) or code in WINDOWS_NO_MEMORY:
        return f"The operating system ended the computation. {MEMORY}"
    if code == ACCESS_VIOLATION or code in (-11, -6, -7, -4, -8, 139, 134):
        number = f"status 0x{code:X}" if code > 255 else f"signal {abs(code)}"
        return (
            f"A library of the environment crashed ({number}); the photographs and QGIS are unharmed. "
            f"Start again; when it crashes again, {SETUP} with a fresh folder."
        )
    if code == MISSING_LIBRARY:
        return (
            "A system library is missing (0xC0000135). Install the 'Microsoft Visual C++ Redistributable' (x64), "
            f"then {SETUP} again."
        )
    missing = re.search(r"No module named '?([\w.]+)", error_text)
    if missing:
        return f"The environment lacks the Python package '{missing.group(1)}': {SETUP}; it adds what is missing."
    if "SyntaxError" in error_text or "unsupported operand type(s) for |" in error_text:
        return f"The Python of the environment is too old; Python 3.10 or newer is needed: {SETUP}."
    last = next((line for line in reversed(error_text.strip().splitlines()) if line.strip()), "it told no reason")
    return f"The worker ended with status {returncode}: {last.strip()[:500]}"


def diagnostics(
    message: str, command: Sequence[str], returncode: int | None, error_text: str, facts: Mapping[str, str]
) -> str:
    """Return a text that tells a helper everything; shown in the log and offered by the menu for copying."""
    lines = [
        "On-the-Fly3R diagnostics",
        f"time: {datetime.now(timezone.utc).isoformat(timespec='seconds')}",
        f"message: {message}",
        *(f"{name}: {value}" for name, value in facts.items()),
        f"system: {platform.platform()}",
        f"Python of QGIS: {sys.version.split()[0]}",
        f"command: {' '.join(command)}",
        f"exit status: {'not started' if returncode is None else returncode}",
        "standard error:",
        *(f"    {line}" for line in error_text.strip().splitlines()[-60:]),
    ]
    return "\n".join(lines)
