"""How a command speaks to whoever started it: a progress bar or JSON lines, exit codes, Ctrl-C, crash notes."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, TextIO

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from .. import protocol
from ..errors import Cancelled, MissingDependencyError, OnTheFly3RError, ReconstructionError, StorageError
from ..files.atomic import write_text
from ..files.ownership import CRASH_NOTE, WORK, holds_map
from ..files.room import is_storage_trouble, storage_error

STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)]


class _PlainConsole(Console):
    """A console that goes quiet when nobody reads it any more; rich's own ends the process."""

    def on_broken_pipe(self) -> None:
        """Stop writing."""
        self.quiet = True


class HumanReporter:
    """A progress bar on standard error and the result as text on standard output."""

    def __init__(self) -> None:
        self.errors = _PlainConsole(stderr=True, highlight=False)
        self._stage = ""
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[counts]}"),
            TextColumn("{task.fields[left]}"),
            TimeElapsedColumn(),
            console=self.errors,
        )
        self._task = self._bar.add_task("starting", total=None, counts="", left="")

    def __enter__(self) -> HumanReporter:
        """Show the bar where there is a terminal to show it on."""
        if self.errors.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Take the bar away."""
        self._bar.stop()

    def progress(self, report: protocol.Progress) -> None:
        """Show how far the run is; without a terminal, one line per stage."""
        counts = f"{report.placed} placed, {report.rejected} rejected, {report.waiting} waiting"
        left = "" if report.eta_s is None else f"{_clock(report.eta_s)} left"
        self._bar.update(
            self._task,
            description=report.stage,
            completed=report.done,
            total=report.total or None,
            counts=counts if report.placed or report.rejected or report.waiting else report.message,
            left=left,
        )
        if not self.errors.is_terminal and report.stage != self._stage:
            print(report.stage, file=sys.stderr, flush=True)
        self._stage = report.stage

    def warning(self, message: str) -> None:
        """Print a warning above the bar."""
        self.errors.print(f"warning: {message}", style="yellow", markup=False, soft_wrap=True)

    def error(self, message: str, exit_code: int) -> None:
        """Print why the command ends."""
        colour = "yellow" if exit_code == Cancelled.exit_code else "red"
        self.errors.print(message, style=colour, markup=False, soft_wrap=True)

    def result(self, data: dict[str, Any], text: str) -> None:
        """Print the result; lines are not broken, so that a path stays whole."""
        self._bar.stop()
        print(text, flush=True)


class JsonReporter:
    """One JSON object per line on standard output, and nothing else there."""

    def __init__(self) -> None:
        self._lines: TextIO = sys.stdout
        self._kept = contextlib.ExitStack()

    def __enter__(self) -> JsonReporter:
        """Keep standard output for the events: what libraries print goes to standard error."""
        if sys.stdout is sys.__stdout__:
            self._lines.flush()
            kept = os.dup(1)
            self._lines = self._kept.enter_context(open(kept, "w", encoding="utf-8", newline="\n"))  # noqa: PTH123 - a descriptor
            self._kept.callback(os.dup2, kept, 1)
            os.dup2(2, 1)
        self._kept.enter_context(contextlib.redirect_stdout(sys.stderr))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Give standard output back."""
        self._kept.close()

    def _emit(self, event: protocol.Event) -> None:
        self._lines.write(event.to_line() + "\n")
        self._lines.flush()

    def progress(self, report: protocol.Progress) -> None:
        """Write a progress event."""
        self._emit(protocol.Event.progress(report))

    def warning(self, message: str) -> None:
        """Write a warning event."""
        self._emit(protocol.Event("warning", {"message": message}))

    def error(self, message: str, exit_code: int) -> None:
        """Write the event that says why the command ends."""
        self._emit(protocol.Event("error", {"message": message, "exit_code": exit_code}))

    def result(self, data: dict[str, Any], text: str) -> None:
        """Write the result event."""
        self._emit(protocol.Event("result", data))


class Session:
    """What a command works with: where it reports, and whether it was asked to stop."""

    def __init__(self, reporter: HumanReporter | JsonReporter, polite: bool) -> None:
        self.reporter = reporter
        self.stop_asked = False
        self._polite = polite
        self._warned: set[str] = set()
        self.lost: OSError | None = None  # why output cannot be written any more

    def cancelled(self) -> bool:
        """Return whether Ctrl-C or a termination signal arrived."""
        return self.stop_asked

    def progress(self, report: protocol.Progress) -> None:
        """Pass a report on; raises `Cancelled` when the user asked to stop."""
        # Importing pycolmap puts a handler of its own in place that ends the process with a stack trace.
        self.listen_to_signals()
        if self.stop_asked:
            raise Cancelled("stopped on request")
        self._write(lambda: self.reporter.progress(report))

    def listen_to_signals(self) -> None:
        """Let Ctrl-C and termination signals ask this session to stop; does nothing outside the main thread."""
        if threading.current_thread() is threading.main_thread():
            for number in STOP_SIGNALS:
                hang_up = number == getattr(signal, "SIGHUP", None)
                if not (hang_up and signal.getsignal(number) is signal.SIG_IGN):  # as `nohup` wants it
                    signal.signal(number, self._stop)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.stop_asked or not self._polite:
            raise KeyboardInterrupt
        self.stop_asked = True

    def warning(self, message: str) -> None:
        """Tell a warning once."""
        if message not in self._warned:
            self._warned.add(message)
            self._write(lambda: self.reporter.warning(message))

    def result(self, data: dict[str, Any], text: str) -> None:
        """Tell the result."""
        self._write(lambda: self.reporter.result(data, text))

    def _write(self, tell: Callable[[], None]) -> None:
        """Tell something; where the output is full or gone, work on: the files are worth more than the words.

        Raises `Cancelled` when the program that reads the JSON lines is gone: nobody waits for the result.
        """
        if self.lost is not None:
            return
        try:
            tell()
        except OSError as error:
            self.lost = error
            _silence_output()
            if isinstance(self.reporter, JsonReporter) and isinstance(error, BrokenPipeError):
                raise Cancelled(
                    "stopped: the program that started this one does not read its output any more"
                ) from error


@contextlib.contextmanager
def session(*, json_lines: bool, out: Path | None = None, polite: bool = True) -> Iterator[Session]:
    """Run a command's body: errors become one sentence and an exit code, never a traceback.

    With `polite`, the first Ctrl-C or termination signal asks the work to stop at its next report and the second
    ends it; without, the first ends it. `out` is the output folder: an unexpected error leaves its traceback there.
    """
    with JsonReporter() if json_lines else HumanReporter() as reporter:
        here = Session(reporter, polite)
        with _signals(here), _warnings_to(here):
            try:
                yield here
                if here.lost is None or here.lost.errno != errno.ENOSPC:
                    return
                message = "the work is done, but its output could not be written: no room left on the disk"
                exit_code = StorageError.exit_code
            except BaseException as error:
                message, exit_code = _explain(error, out)
        with contextlib.suppress(OSError):
            reporter.error(message, exit_code)
    raise typer.Exit(exit_code)


def _silence_output() -> None:
    """Send what is left in the buffers of a lost output nowhere, so that the interpreter does not complain of it."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.__stdout__, sys.__stderr__):
            if stream is None:
                continue
            try:
                stream.flush()
            except OSError:
                os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _explain(error: BaseException, out: Path | None) -> tuple[str, int]:
    """Return what to say of an error, and the exit code; raises what is no error."""
    if isinstance(error, OnTheFly3RError):
        message, exit_code = str(error), error.exit_code
        if isinstance(error, ReconstructionError) and error.report is not None:
            message += f"; the report is in {error.report}"
    elif isinstance(error, (KeyboardInterrupt, BrokenPipeError)):
        message, exit_code = "stopped on request", Cancelled.exit_code
    elif isinstance(error, MemoryError):
        message, exit_code = "not enough memory: lower --working-px or --dense-px, or close other programs", 1
    elif isinstance(error, ImportError):
        message = f"{error}: the command 'onthefly3r doctor' says what is missing and how to install it"
        exit_code = MissingDependencyError.exit_code
    elif isinstance(error, OSError) and is_storage_trouble(error):
        message, exit_code = str(storage_error(error, out)), StorageError.exit_code
    elif isinstance(error, Exception):
        message = f"unexpected {type(error).__name__}: {error}; the traceback is in {_note_crash(error, out)}"
        exit_code = 1
    else:
        raise error
    way_on = getattr(error, "way_on", "")
    return f"{message}; {way_on}" if way_on else message, exit_code


@contextlib.contextmanager
def _signals(here: Session) -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    here.listen_to_signals()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextlib.contextmanager
def _warnings_to(here: Session) -> Iterator[None]:
    """Pass what the package logs as a warning to the user."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            here.warning(record.getMessage())

    logger = logging.getLogger("onthefly3r")
    handler = Handler(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _note_crash(error: BaseException, folder: Path | None) -> Path:
    """Save the traceback beside the map of a run of ours in `folder`, else in the temporary folder."""
    text = "".join(traceback.format_exception(error))
    if folder is not None and holds_map(folder):
        note = folder / WORK / CRASH_NOTE
        with contextlib.suppress(OSError):
            write_text(note, text)
            return note
    with contextlib.suppress(OSError):
        descriptor, name = tempfile.mkstemp(prefix="onthefly3r-crash-", suffix=".txt")
        with open(descriptor, "w", encoding="utf-8", errors="backslashreplace") as stream:  # noqa: PTH123 - a descriptor
            stream.write(text)
        return Path(name)
    sys.stderr.write(text)
    return Path("standard error")


def use_utf8() -> None:
    """Let both streams carry any file name, on Windows consoles too."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(encoding="utf-8", errors="replace")


def columns(facts: dict[str, str]) -> str:
    """Return names and values as text in two columns."""
    width = max(map(len, facts), default=0)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in facts.items())


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
