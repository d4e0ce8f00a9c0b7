"""Many flights in one go: each in a process of its own, one row of results each, failures told and passed over."""

from __future__ import annotations

import csv
import io
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from ..errors import Cancelled, InputError, OptionError, ReconstructionError
from ..files.atomic import write_text
from ..files.owned import OwnedFolder
from ..files.ownership import WORK
from ..files.strict_json import loads
from ..intake.folder import find_photographs
from ..options import Options, over_earlier
from ..protocol import Event, Job, Progress, ProgressCallback

Status = Literal["done", "failed", "skipped"]

MAX_TABLE_BYTES = 16 * 1024 * 1024
TABLE = "flights.csv"
OWN_COLUMNS = ("name", "photos")
SOURCE = Path(__file__).resolve().parents[2]  # a flight runs by the same source as the batch
POLL_S = 0.1
GRACE_S = 1.0
MEMORY_REMEDY = "most likely the memory did not suffice: lower working_px or dense_px"


@dataclass(frozen=True)
class Flight:
    """One folder of photographs, and the options that its row of the table sets."""

    name: str  # also the name of its folder of results
    photos: Path
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FlightResult:
    """One row of the result table; None where a flight did not get that far."""

    flight: str
    status: Status
    message: str = ""
    photos: str = ""
    out: str = ""
    given: int | None = None
    placed: int | None = None
    crs: str | None = None
    rmse_h_m: float | None = None
    rmse_v_m: float | None = None
    points: int | None = None
    time_s: float | None = None
    memory_mib: float | None = None
    report: str | None = None


def read_flights(source: Path, leave_out: Path | None = None) -> list[Flight]:
    """Return the flights of a parent folder (its sub-folders with photographs) or of a table (CSV).

    The table needs a column `photos` (folders, relative to the table); `name` and columns named like options are
    taken where there are any, empty cells leave the default. `leave_out` is no flight: the folder of results. Raises
    `InputError`.
    """
    flights = _from_folder(source, leave_out) if source.is_dir() else _from_table(source)
    names = Counter(flight.name.casefold() for flight in flights)  # some systems take A and a for the same folder
    name, times = names.most_common(1)[0]
    if times > 1:
        raise InputError(f"{source}: the name {name} occurs {times} times; flights need different names")
    return flights


def reconstruct_flights(
    flights: Sequence[Flight],
    out: Path,
    options: Options,
    skip_done: bool = False,
    progress: ProgressCallback | None = None,
    cancel: Callable[[], bool] | None = None,
) -> list[FlightResult]:
    """Reconstruct each flight into out/NAME and keep out/flights.csv up to date; return one row per flight.

    Args:
        flights: of `read_flights`.
        out: folder of all results; it is made.
        options: of every flight, where its row does not say otherwise.
        skip_done: leave flights alone whose report tells of no error.
        progress: told how far all flights are, in hundredths of a flight.
        cancel: asked while a flight runs; true ends it, and raises `Cancelled`.

    Raises `InputError` when `out` holds a flights.csv that is not ours, and as `OwnedFolder.claim` does.
    """
    rows: list[FlightResult] = []
    with OwnedFolder.claim(out, "batch", names=(TABLE,), guest=True) as owned:
        for number, flight in enumerate(flights):
            folder = out / (f"{flight.name}_" if flight.name.casefold() == WORK else flight.name)
            if skip_done and _succeeded(folder):
                row = _result(flight, folder, "skipped", "done before")
            else:
                follow = _follower(progress, number, len(flights), flight.name)
                row = _reconstruct(flight, folder, options, follow, cancel)
            rows.append(row)
            with owned.scratch() as made:
                write_table(made / TABLE, rows)
                owned.publish(made, "flights")
            if progress is not None:
                progress(Progress(flight.name, 100 * (number + 1), 100 * len(flights), message=row.status))
    return rows


def write_table(path: Path, rows: Sequence[FlightResult]) -> None:
    """Write the rows as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [item.name for item in fields(FlightResult)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_text(path, text.getvalue())


# ---------------------------------------------------------------------- which flights


def _from_folder(parent: Path, leave_out: Path | None) -> list[Flight]:
    results = None if leave_out is None else leave_out.resolve()
    inner = (path for path in parent.iterdir() if path.is_dir() and not path.name.startswith("."))
    folders = sorted(path for path in inner if path.resolve() != results)
    flights = [Flight(folder.name, folder) for folder in folders if find_photographs(folder, recursive=True)]
    if not flights:
        raise InputError(f"{parent}: none of its sub-folders holds photographs; each flight needs one of its own")
    return flights


def _from_table(path: Path) -> list[Flight]:
    try:
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise InputError(f"{path}: larger than {MAX_TABLE_BYTES // 2**20} MiB and no table of flights")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no table of flights ({error}); give a CSV file in UTF-8, or a folder") from error
    head = text.split("\n", 1)[0]
    rows = list(csv.DictReader(text.splitlines(), delimiter=max(",;\t", key=head.count)))
    if not rows or "photos" not in rows[0]:
        raise InputError(f"{path}: needs a first line with the column photos, and a line for each flight")
    flights = []
    for line, row in enumerate(rows, start=2):
        cells = {key.strip(): value.strip() for key, value in row.items() if key and value and value.strip()}
        if "photos" not in cells:
            raise InputError(f"{path}, line {line}: names no folder of photographs")
        photos = path.parent / cells["photos"]
        chosen = {name: _value(value) for name, value in cells.items() if name not in OWN_COLUMNS}
        try:
            Options.from_flat(chosen)
        except OptionError as error:
            raise InputError(f"{path}, line {line}: {error}") from error
        flights.append(Flight(_safe(cells.get("name") or photos.name), photos, chosen))
    return flights


def _value(text: str) -> Any:
    """Return a cell as the type that options have: truth, whole number, number, or text."""
    truths = {"true": True, "on": True, "yes": True, "false": False, "off": False, "no": False}
    if text.casefold() in truths:
        return truths[text.casefold()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _safe(name: str) -> str:
    """Return a name that is one folder on every system, inside the output folder."""
    safe = re.sub(r'[<>:"/\\|?*\x00-\x1f]+', "_", name).strip(" .")
    if not safe:
        raise InputError(f"{name!r} is no name for a flight")
    return safe


# ---------------------------------------------------------------------- one flight


def _follower(progress: ProgressCallback | None, number: int, total: int, name: str) -> Callable[[Event], None]:
    """Return what turns a flight's own progress into that of all flights."""

    def follow(event: Event) -> None:
        if progress is None or event.kind != "progress":
            return
        placed, rejected, waiting = (int(event.data.get(key, 0)) for key in ("placed", "rejected", "waiting"))
        share = placed / (placed + rejected + waiting) if placed else 0.0
        message = str(event.data.get("stage", ""))
        progress(Progress(name, 100 * number + int(99 * share), 100 * total, placed, rejected, waiting, None, message))

    return follow


def _reconstruct(
    flight: Flight,
    folder: Path,
    options: Options,
    follow: Callable[[Event], None],
    cancel: Callable[[], bool] | None,
) -> FlightResult:
    # Only what was named: a row's preset then still decides about the rest.
    job = Job("run", (str(flight.photos), str(folder)), over_earlier(options.to_named(), flight.options))
    began = time.monotonic()
    returncode, error = _run(job, follow, cancel)
    if returncode == 0:
        return _result(flight, folder, "done", "")
    message = error or _ended_badly(returncode)
    if returncode == ReconstructionError.exit_code:
        return _result(flight, folder, "failed", message)
    return FlightResult(
        flight.name, "failed", message, str(flight.photos), str(folder), time_s=round(time.monotonic() - began, 1)
    )


def _run(job: Job, follow: Callable[[Event], None], cancel: Callable[[], bool] | None) -> tuple[int, str]:
    """Run a job in a process of its own; return its exit status and the message of its error."""
    told = ""

    def read(lines: Any) -> None:
        nonlocal told
        for line in lines:
            try:
                event = Event.from_line(line)
            except ValueError:
                continue
            if event.kind == "error":
                told = str(event.data.get("message", ""))
            follow(event)

    with tempfile.TemporaryDirectory(prefix="onthefly3r-") as scratch:
        file = Path(scratch) / "job.json"
        job.write(file)
        process = subprocess.Popen(
            [sys.executable, "-m", "onthefly3r", "job", str(file)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONPATH": str(SOURCE), "PYTHONUTF8": "1"},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        reader = threading.Thread(target=read, args=(process.stdout,), daemon=True)
        reader.start()
        try:
            while process.poll() is None:
                if cancel is not None and cancel():
                    raise Cancelled("stopped on request; flights.csv lists what was done before")
                time.sleep(POLL_S)
        finally:
            _end(process)
            reader.join(timeout=5.0)
            if process.stdout is not None:
                process.stdout.close()
    return process.returncode, told


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _ended_badly(returncode: int) -> str:
    if returncode in (-9, 137):
        return f"the operating system ended the computation; {MEMORY_REMEDY}"
    return f"the computation ended with status {returncode} without a reason"


def _succeeded(folder: Path) -> bool:
    report = _report(folder)
    return report is not None and report.get("error") is None and report.get("images", {}).get("placed", 0) > 0


def _result(flight: Flight, folder: Path, status: Status, message: str) -> FlightResult:
    report = _report(folder) or {}
    images, geo, cloud = (report.get(key) or {} for key in ("images", "georeference", "cloud"))
    return FlightResult(
        flight=flight.name,
        status=status,
        message=message,
        photos=str(flight.photos),
        out=str(folder),
        given=images.get("given"),
        placed=images.get("placed"),
        crs=geo.get("crs"),
        rmse_h_m=geo.get("rmse_h_m"),
        rmse_v_m=geo.get("rmse_v_m"),
        points=cloud.get("points"),
        time_s=(report.get("timing") or {}).get("total_s"),
        memory_mib=(report.get("memory") or {}).get("peak_rss_mib"),
        report=str(folder / "report.html"),
    )


def _report(folder: Path) -> dict[str, Any] | None:
    try:
        report = loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return report if isinstance(report, dict) else None
