"""The files of a run written again, from a finished run or from what an unfinished one left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..earth.control_file import control_of
from ..earth.georef import check_crs
from ..earth.ground import ground_normal
from ..errors import InputError
from ..intake.positions_file import read_positions, with_positions
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..products.clip import require_boundary_near
from ..protocol import ProgressCallback
from ..records import GeoReference, Shot
from ..stopwatch import Stopwatch
from .parts import main_part, main_reference
from .record import RunRecord
from .result import Mapped, Result, write_result
from .run_folder import FAILURE, PRODUCT_FILES, RESULT, RunFolder, settle


def export(
    run: Path,
    out: Path,
    options: Options | None = None,
    progress: ProgressCallback | None = None,
    partial: bool = False,
) -> Result:
    """Write the files of an earlier run again into `out`, with another CRS, format or spacing.

    A run that did not end gives what was placed by then, and the report says so. `out` may be the folder of the run.
    With `partial`, a damaged one gives what is undamaged, and the warnings say what is lost.

    Raises:
        InputError: `run` holds no map, an option is wrong, or `out` holds what is not ours; nothing was changed.
        ReconstructionError: the map cannot be georeferenced, or has no points; a report is written.
        StorageError: no room or no access; an earlier result is as it was.
    """
    out, options = Path(out), options or Options()
    stopwatch = Stopwatch()
    mapped = open_run(Path(run), options, partial)
    with RunFolder.claim(out, "export", names=PRODUCT_FILES) as folder:
        return write_result(
            folder,
            mapped,
            options,
            stopwatch,
            lambda made: folder.publish(made, RESULT, clears=(FAILURE,)),
            progress,
            None,
        )


def georeference(run: Path, options: Options | None = None) -> GeoReference:
    """Return how the map of a run lies on the Earth with these options; nothing is written.

    Raises `InputError` when `run` holds no map, `GeoreferenceError` when its positions do not suffice.
    """
    options = options or Options()
    mapped = open_run(Path(run), options)
    state = mapped.state
    return main_reference(state, mapped.record.shots, options.georeference, ground_normal(main_part(state)))


def open_run(run: Path, options: Options, partial: bool = False) -> Mapped:
    """Return the map in the folder of a run, with the positions that the options name; raises `InputError`."""
    if not run.is_dir():
        raise InputError(f"{run}: no such folder; name the output folder of a run")
    settle(run)
    store = Store(run / "work", partial)
    state = MapState.load(store)
    record = RunRecord.read(run / "work")
    if partial:
        store.look_at_chunks()
        record = replace(record, warnings=[*record.warnings, *store.lost])
    unknown = next((index for index in state.frames if index not in record.shots), None)
    if unknown is not None:
        raise InputError(
            f"{run / 'work'}: the journal places photograph {unknown}, which run.json does not know; run again"
        )
    if options.georeference.positions is not None:
        file = read_positions(Path(options.georeference.positions))
        placed, told = with_positions([shot for _, shot in sorted(record.shots.items())], file)
        shots = dict(zip(sorted(record.shots), placed, strict=True))
        record = replace(record, shots=shots, warnings=[*record.warnings, *told])
    require_fitting(list(record.shots.values()), options)
    return Mapped(state, store, record)


def require_fitting(shots: Sequence[Shot], options: Options) -> None:
    """Raise `InputError` when the CRS or the boundary is none for these photographs: told before the work."""
    check_crs(dict(enumerate(shots)), options.georeference)
    control_of(options.georeference)  # a file that is wrong is told before the work, not after it
    if options.export.boundary is not None:
        require_boundary_near(Path(options.export.boundary), list(shots))
