"""The output folder of a run: products beside the map in `work`, which `export` reads and a stopped run leaves."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError
from ..files.owned import OwnedFolder, relative_files, require_free
from ..files.ownership import CRASH_NOTE, MAP, WORK, Listed, Stamp, fingerprint, read_stamp
from ..files.room import storage_errors
from ..files.strict_json import loads
from ..products.catalogue import PRODUCTS

RESULT, FAILURE = "result", "failure"  # groups of files, each replaced as a whole, beside that of the map
REPORTS = ("report.json", "report.html")
FAILED_REPORTS = ("failed-report.json", "failed-report.html")  # of a run that left an earlier result as it was
PRODUCT_FILES = tuple(name for product in PRODUCTS for name in product.files)
MAX_REPORT_BYTES = 64 * 2**20

_PART = r"\.onthefly3r-[0-9a-f]{16}\.part"
_ARRAYS = rf"(chunks|features|features/more)/(\d{{6}}(\.part|\.seen)?|learnt|{_PART})\.npz|features/\d{{6}}\.rgb"
_MAP_FILE = re.compile(rf"journal\.jsonl|run\.json|{re.escape(CRASH_NOTE)}|{_PART}\.(json|txt)|{_ARRAYS}")
FOLDERS = ("chunks", "features/more", "features")  # below `work`
_MAP_NAMES = ("journal.jsonl", "run.json", "chunks", "features")


class RunFolder(OwnedFolder):
    """The folder that `run` and `export` write into.

    The map of a first run grows in `work`. Where a finished result is, that of the next run grows in a folder of its
    own below `work`, which has the same layout, and comes to its place together with the products.
    """

    attempt: str | None = None  # name of the folder of its own

    @classmethod
    def _look(cls, path: Path, names: Iterable[str], guest: bool) -> Stamp | None:
        stamp = super()._look(path, names, guest)
        if stamp is None or not stamp.has_map:
            taken = next((path / WORK / name for name in _MAP_NAMES if os.path.lexists(path / WORK / name)), None)
            if taken is not None:
                raise InputError(f"{taken}: was not written by this program; move it away, or name another folder")
        return stamp

    @classmethod
    def _not_ours(cls, path: Path) -> str:
        if (path / WORK / "run.json").is_file() or _report_of_ours(path / "report.json"):
            return (
                "from a release that did not list what it wrote, so that nothing in it can be replaced safely; name "
                "another folder, or remove this one yourself ('onthefly3r export' still reads it)"
            )
        return super()._not_ours(path)

    @property
    def is_finished(self) -> bool:
        """Whether the folder holds the products of an earlier run or export."""
        return any(item.group == RESULT and name not in REPORTS for name, item in self.stamp.files.items())

    @property
    def home(self) -> Path:
        """The folder in whose `work` the map of this run is."""
        return self.path if self.attempt is None else self.path / self.attempt

    def unfinished(self) -> Path | None:
        """Return the work folder of a run that did not end and goes on from there, None where there is none."""
        attempts = [name for name in self.stamp.scratch if self._is_kept(name)]
        homes: list[str | None] = [*attempts, *([None] if self.stamp.map_open else [])]
        for attempt in homes:
            work = (self.path if attempt is None else self.path / attempt) / WORK
            if (work / "run.json").is_file():
                self.attempt = attempt
                return work
        return None

    def plan_map(self) -> Path:
        """Decide where the map of a new run grows, and return that work folder; nothing is written."""
        self.attempt = None
        if any(item.group == MAP for item in self.stamp.files.values()):
            self.attempt = f"{WORK}/attempt-{secrets.token_hex(8)}"
        return self.home / WORK

    def begin_map(self) -> None:
        """Make the folder that `plan_map` named; the map of an unfinished run is removed, a finished one stays."""
        with storage_errors(self.path):
            for name in [name for name in self.stamp.scratch if self._is_kept(name)]:
                self.drop_scratch(name)
            if self.attempt is not None:
                self.make_scratch(self.attempt)
            else:
                self._remove_open_map()
                self.stamp.map_open = True
                self.stamp.write(self.path)
            (self.home / WORK).mkdir(parents=True, exist_ok=True)

    def abandon_map(self) -> None:
        """Remove the map that `begin_map` began, when nothing in it is worth keeping."""
        with contextlib.suppress(OSError):
            if self.attempt in self.stamp.scratch:
                self.drop_scratch(self.attempt)
            elif self.stamp.map_open:
                self._remove_open_map()

    def publish_run(self, made: Path) -> None:
        """Swap in the products below `made` together with the map of this run; raises as `publish` does."""
        with storage_errors(self.path):
            products = relative_files(made)
            require_free(self.path, self.stamp, products)
            maps = [name for name in _map_files(self.home / WORK) if not name.startswith(f"{WORK}/features/")]
            sources = {name: (made / name).relative_to(self.path).as_posix() for name in products}
            if self.attempt is not None:
                sources |= {name: f"{self.attempt}/{name}" for name in maps}
            was_open, self.stamp.map_open = self.stamp.map_open, False
            groups = {
                RESULT: {name: Listed(RESULT, fingerprint(made / name)) for name in products},
                MAP: {name: Listed(MAP) for name in maps},
                FAILURE: {},
            }
            try:
                self._swap_in(groups, sources)
            except BaseException:
                self.stamp.map_open = was_open
                raise
            if self.attempt is not None:
                self.drop_scratch(self.attempt)
                self.attempt = None

    def _remove_open_map(self) -> None:
        for name in _map_files(self.path / WORK):
            (self.path / name).unlink(missing_ok=True)
        for name in FOLDERS:
            with contextlib.suppress(OSError):  # not there, or it holds what is not ours
                (self.path / WORK / name).rmdir()
        self.stamp.map_open = False
        self.stamp.write(self.path)

    def _is_kept(self, scratch: str) -> bool:
        return "/attempt-" in scratch


def settle(run: Path) -> None:
    """End the swap of files that a power cut or a kill left half done; raises as `RunFolder.claim` does."""
    stamp = read_stamp(run)
    if stamp is not None and stamp.publication is not None:
        with RunFolder.claim(run, "recover"):
            pass


def _map_files(work: Path) -> list[str]:
    """Return the files of a map by their names, relative to the folder above `work`; links are not followed."""
    found = []
    for parent, _, names in os.walk(work):
        for name in names:
            path = Path(parent, name)
            if _MAP_FILE.fullmatch(path.relative_to(work).as_posix()) and not path.is_symlink():
                found.append(f"{WORK}/{path.relative_to(work).as_posix()}")
    return sorted(found)


def _report_of_ours(path: Path) -> bool:
    try:
        if path.stat().st_size > MAX_REPORT_BYTES:
            return False
        report = loads(path.read_text(encoding="utf-8"))
        return "backbone" in report["software"] and "placed" in report["images"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False
