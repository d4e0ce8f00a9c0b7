"""What a Python program gets by one import, and that getting it changes nothing in the process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import onthefly3r

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")


def run_python(code: str) -> str:
    environ = {**os.environ, "PYTHONPATH": str(ROOT / "core")}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environ, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_every_public_name_is_there_and_documented() -> None:
    for name in onthefly3r.__all__:
        assert getattr(onthefly3r, name) is not None
        assert name in PAGE or name in ("Engine", "Result", "__version__"), name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = onthefly3r.nothing


def test_imports_of_the_documentation_work_and_its_code_is_valid() -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) >= 5
    for block in blocks:
        compile(block, "docs/python.md", "exec")
    imports = [re.search(r"from onthefly3r import (\([^)]*\)|[^\n]*)", block) for block in blocks]
    run_python("\n".join(found.group(0) for found in imports if found))


def test_function_and_folder_of_one_name_are_both_there() -> None:
    told = run_python(
        "from onthefly3r.evaluate.comparison import evaluate as function\n"
        "from onthefly3r import evaluate\n"
        "from onthefly3r.errors import OnTheFly3RError\n"
        "for call in (function, evaluate):\n"
        "    try:\n"
        "        call(__import__('pathlib').Path('nowhere'))\n"
        "    except OnTheFly3RError as error:\n"
        "        print(error)"
    )
    first, second = told.splitlines()
    assert first == second


@pytest.mark.skipif(os.name == "nt", reason="Windows has other signals")
def test_signal_handlers_of_the_caller_stay() -> None:
    """Those that Python knows of and those that it does not."""
    run_python(
        "import signal, onthefly3r\n"
        "signal.signal(signal.SIGTERM, lambda number, frame: None)\n"
        "numbers = signal.valid_signals()\n"
        "def read():\n"
        "    if not __import__('os').path.exists('/proc/self/status'):\n"
        "        return 0\n"
        "    lines = dict(line.split(':') for line in open('/proc/self/status') if line.startswith('Sig'))\n"
        "    return int(lines['SigCgt'], 16) & 0x7fffffff, lines['SigIgn']\n"  # above are those of the C library
        "before = {number: signal.getsignal(number) for number in numbers}, read()\n"
        "from onthefly3r.features.pycolmap_module import load_pycolmap\n"
        "load_pycolmap()\n"
        "from onthefly3r import Session, reconstruct, export, check_photographs, evaluate\n"
        "after = {number: signal.getsignal(number) for number in numbers}, read()\n"
        "assert before == after, (before, after)"
    )
