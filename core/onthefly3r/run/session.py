"""One run: photographs are fed, the map grows, the files are written. `run`, Python and QGIS all go through it."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ..backbones.registry import create_backbone
from ..engine.loop import Engine
from ..errors import Cancelled, InputError
from ..features.extraction import FeatureStore
from ..files.room import MIB, is_storage_trouble, require_room, storage_error
from ..intake.images import load_working_image
from ..intake.reading import read_flight
from ..options import Options, over_earlier
from ..protocol import Progress, ProgressCallback
from ..records import RefusedPhotograph, Shot
from ..selection.describer import create_describer
from ..stopwatch import Stopwatch
from .export import require_fitting
from .going_on import require_same_map, same_photographs
from .record import RunRecord
from .result import Mapped, Result, write_failure, write_result
from .run_folder import PRODUCT_FILES, RunFolder

RECORD_EVERY_S = 10.0
# What one photograph takes on the disk while a run lasts: its features, and a point of the map, its place in the
# store and in the cloud, for each pixel of the dense grid.
FEATURE_BYTES, POINT_BYTES = 160, 60


def reconstruct(
    photos: Path,
    out: Path,
    options: Options | None = None,
    progress: ProgressCallback | None = None,
    cancel: Callable[[], bool] | None = None,
    anew: bool = False,
) -> Result:
    """Reconstruct a folder of photographs into `out`; same names and defaults as the command line.

    An earlier result in `out` is replaced when the new one is complete, and stays as it was when that fails. A run in
    `out` that did not end goes on, unless it is to begin `anew`.

    Raises:
        InputError: the folder, an option or the environment is wrong, `out` holds what is not ours, or a run that did
            not end of other photographs or options; nothing was changed.
        ReconstructionError: nothing could be reconstructed or georeferenced; a report is written.
        StorageError: no room or no access.
        Cancelled: `cancel` returned true.
    """
    with Session.open(out, options, progress, cancel, anew) as session:
        session.feed_folder(Path(photos))
        return session.finish()


def resume(
    out: Path,
    named: Mapping[str, Any] | None = None,
    progress: ProgressCallback | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Result:
    """Go on with a run in `out` that did not end, with its own options but for the `named` ones.

    Raises as `reconstruct` does; `InputError` too when there is no such run, or its photographs are gone.
    """
    with Session.open(out, None, progress, cancel) as session:
        session.take_up(named or {})
        return session.finish()


class Session:
    """A run under way: feed photographs, step, finish. Made by `Session.open`."""

    def __init__(
        self,
        folder: RunFolder,
        options: Options,
        progress: ProgressCallback | None = None,
        cancel: Callable[[], bool] | None = None,
        anew: bool = False,
    ) -> None:
        self.folder = folder
        self.options = options
        self.refused: list[RefusedPhotograph] = []
        self.photos = ""
        self._stopwatch = Stopwatch()
        self._progress = progress
        self._cancel = cancel
        self._engine: Engine | None = None
        self._work: Path | None = None
        self._recorded_s = 0.0
        self._mapped = False
        self._facts: dict[str, object] = {}
        self._anew = anew

    @classmethod
    @contextlib.contextmanager
    def open(
        cls,
        out: Path,
        options: Options | None = None,
        progress: ProgressCallback | None = None,
        cancel: Callable[[], bool] | None = None,
        anew: bool = False,
    ) -> Iterator[Session]:
        """Claim `out` for a run and yield its session; what a block that fails leaves can be gone on with and exported.

        A run that did not end is gone on with by the first `feed`, unless it is to begin `anew`.

        Raises as `RunFolder.claim` does.
        """
        options = options or Options()
        with RunFolder.claim(Path(out), "run", names=PRODUCT_FILES) as folder:
            session = cls(folder, options, progress, cancel, anew)
            try:
                yield session
            except BaseException as error:
                session._keep(error)
                if isinstance(error, OSError) and is_storage_trouble(error):
                    raise storage_error(error, folder.path) from error
                raise

    @property
    def placed(self) -> int:
        """Number of photographs that the map holds."""
        return len(self._engine.state.frames) if self._engine else 0

    def feed_folder(self, photos: Path) -> None:
        """Read the photographs of a folder and take them all; raises `InputError` when it holds none."""
        with self._stopwatch.stage("intake"):
            flight = read_flight(photos, self.options, leave_out=self.folder.path)
        self.photos = str(photos.absolute())
        self.feed(flight.shots, flight.refused, flight.warnings)

    def take_up(self, named: Mapping[str, Any]) -> None:
        """Go on with the run in the folder with its own photographs and options, but for the `named` ones.

        Raises `InputError` when there is no such run, its photographs are gone, or an option would change its map.
        """
        earlier = self._earlier()
        if earlier is None:
            done = "the run in it is finished" if self.folder.stamp.has_map else "it holds no run"
            raise InputError(f"{self.folder.path}: there is nothing to go on with ({done})")
        self.options = Options.from_flat(over_earlier(earlier.options, named))
        shots = [earlier.shots[index] for index in sorted(earlier.shots)]
        if shots and not any(shot.path.is_file() for shot in shots):
            raise InputError(
                f"{earlier.photos}: the photographs of the run in {self.folder.path} are not there; connect their "
                f"drive, or name where they are now: 'onthefly3r run PHOTOS {self.folder.path}'"
            )
        self.photos = earlier.photos
        self._take(shots, earlier.refused, earlier.warnings, earlier)

    def feed(
        self, shots: Sequence[Shot], refused: Sequence[RefusedPhotograph] = (), warnings: Sequence[str] = ()
    ) -> None:
        """Take photographs that are whole; those that were `refused` are only counted, `warnings` go to the report.

        Raises `InputError` when CRS, positions or boundary do not go with them, `StorageError` without room for them.
        """
        earlier = self._earlier() if self._engine is None and not self._anew else None
        if earlier is not None:
            shots = same_photographs(earlier, shots, self.folder.path)
        self._take(shots, refused, warnings, earlier)

    def _take(
        self,
        shots: Sequence[Shot],
        refused: Sequence[RefusedPhotograph],
        warnings: Sequence[str],
        earlier: RunRecord | None,
    ) -> None:
        """Take shots, those of the `earlier` run that is gone on with among them."""
        if earlier is not None:
            require_same_map(earlier, self.options, self.folder.path)
        known = list(self._engine.shots.values()) if self._engine else []
        require_fitting([*known, *shots], self.options)
        require_room(self.folder.path, room_bytes(len(shots), self.options), f"a run of {len(shots)} photographs")
        engine = self._engine
        if engine is None:
            engine = self._begin(goes_on=earlier is not None)
            shots = self._take_up(engine, shots) if earlier is not None else shots
        self.refused += [item for item in refused if item not in self.refused]
        engine.warnings += [text for text in warnings if text not in engine.warnings]
        self._record(to_come=shots)  # before they are read, so that the record of a run that is killed then is whole
        if not shots:
            return
        with single_threaded_blas():
            engine.add_all(shots)

    def _earlier(self) -> RunRecord | None:
        """Return the record of the run in the folder that did not end, None without one."""
        work = self.folder.unfinished()
        return None if work is None else RunRecord.read(work)

    def _take_up(self, engine: Engine, shots: Sequence[Shot]) -> Sequence[Shot]:
        try:
            return engine.take_up(shots)
        except InputError as error:
            self._engine = None  # leave everything as it is
            raise InputError(
                f"{self.folder.path}: its run cannot be gone on with: {error}; 'onthefly3r export "
                f"{self.folder.home} NEW-FOLDER' writes what it holds, 'onthefly3r run --anew' begins again"
            ) from error

    def step(self) -> None:
        """Place photographs as far as those at hand allow; the rest waits for more, or for `finish`."""
        if self._engine is None:
            raise InputError("the session has no photographs: feed some")
        with single_threaded_blas():
            self._engine.advance()
        self._record()

    def finish(self) -> Result:
        """Place what is still waiting, and write all files; raises as `reconstruct` does."""
        engine, work = self._engine, self._work
        if engine is None or work is None:
            raise InputError("the session has no photographs: feed some")
        with single_threaded_blas():
            engine.finish()
        shutil.rmtree(work / "features", ignore_errors=True)
        record = self._record(mapped=True)
        return write_result(
            self.folder,
            Mapped(engine.state, engine.store, record),
            self.options,
            self._stopwatch,
            self.folder.publish_run,
            self._progress,
            self._cancel,
        )

    def _begin(self, goes_on: bool) -> Engine:
        """Make the engine and the folder that its map grows in; what lacks for a run is told before anything goes."""
        backbone_options = self.options.backbone
        work = (self.folder.unfinished() if goes_on else None) or self.folder.plan_map()
        features = FeatureStore(work / "features", backbone_options.features, backbone_options.threads)
        backbone = create_backbone(backbone_options, features)
        describer = create_describer(self.options.selection, features, backbone_options.device)
        if not goes_on:
            self.folder.begin_map()
        engine = Engine(
            work,
            self.options,
            backbone,
            describer,
            lambda shot: load_working_image(shot, backbone_options.working_px, engine.warnings.append),
            self._follow,
            self._cancel,
        )
        engine.stopwatch = self._stopwatch
        self._facts = backbone.spec.facts()
        self._work, self._engine = work, engine
        return engine

    def _follow(self, progress: Progress) -> None:
        if time.monotonic() - self._recorded_s > RECORD_EVERY_S:
            self._record()
        if self._progress is not None:
            self._progress(progress)

    def _record(self, mapped: bool = False, error: str | None = None, to_come: Sequence[Shot] = ()) -> RunRecord:
        engine, work = self._engine, self._work
        assert engine is not None and work is not None
        record = RunRecord(
            options=self.options.to_flat(),
            backbone=engine.backbone_name,
            backbone_facts=self._facts,
            photos=self.photos,
            stage="mapped" if mapped else "reconstructing",
            error=error,
            shots={**engine.shots, **{len(engine.shots) + number: shot for number, shot in enumerate(to_come)}},
            refused=self.refused,
            rejections=engine.rejections,
            retries=engine.retries,
            details=engine.details(),
            warnings=engine.warnings,
        )
        record.write(work)
        self._recorded_s, self._mapped = time.monotonic(), mapped
        return record

    def _keep(self, error: BaseException) -> None:
        """Keep the map that a failure leaves, and say in the error how to use it; remove one that holds nothing."""
        if self._engine is None or not (self.folder.attempt or self.folder.stamp.map_open):
            return  # nothing was begun, or everything is in its place
        is_stop = isinstance(error, Cancelled | OSError | MemoryError) or not isinstance(error, Exception)
        if not self.placed and not self._mapped and not is_stop:
            self.folder.abandon_map()
            return
        if not self._mapped:  # else the failure is one of the export, which has reported it
            with contextlib.suppress(Exception):  # what ended the run is to be heard, not this
                record = self._record(error=str(error) or type(error).__name__)
                if isinstance(error, Exception) and not isinstance(error, Cancelled):
                    mapped = Mapped(self._engine.state, self._engine.store, record)
                    write_failure(self.folder, mapped, self.options, self._stopwatch, error)
        given = len(self._engine.shots) + len(self.refused)
        ways = []
        if is_stop:
            ways.append(f"'onthefly3r resume {self.folder.path}' goes on")
        if self.placed:
            ways.append(f"'onthefly3r export {self.folder.home} NEW-FOLDER' writes their files")
        if ways:
            error.way_on = f"{self.placed} of {given} photographs are placed: {', '.join(ways)}"  # type: ignore[attr-defined]


def room_bytes(photographs: int, options: Options) -> int:
    """Return about how many bytes a run over so many photographs writes."""
    grid = 0.75 * options.backbone.dense_px**2
    return int(20 * MIB + photographs * (options.backbone.features * FEATURE_BYTES + grid * POINT_BYTES))


def single_threaded_blas() -> AbstractContextManager[object]:
    """Keep the linear algebra below numpy and scipy to one thread for a while.

    Images and pairs are worked on in several threads already: with more below them, they wait for each other.
    """
    import scipy.linalg  # noqa: F401 - only libraries that are loaded are found
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limits
