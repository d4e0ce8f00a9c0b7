"""From a map to the files of the user: georeference, products, and, whatever happens, the report."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..earth.ground import ground_normal
from ..earth.local_level import local_frame, scale_warning
from ..errors import Cancelled, GeoreferenceError, ReconstructionError
from ..files.las_index import indexes_beside, indexes_of
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..products.catalogue import layers_in
from ..products.exportframe import ExportFrame
from ..products.las import CloudSummary
from ..products.page import write_page
from ..products.report import RejectedImage, RunSummary, Timing, build_report, write_report
from ..products.reportfigures import figures
from ..products.runview import RunView
from ..products.writing import write_products
from ..protocol import Progress, ProgressCallback
from ..records import GeoReference
from ..stopwatch import Stopwatch, peak_rss_mib
from .parts import laid_out, main_part, main_reference
from .record import RunRecord
from .run_folder import FAILED_REPORTS, FAILURE, REPORTS, RESULT, RunFolder
from .verdict import doubtful_positions, misfits, raise_for, shortfall


@dataclass(frozen=True)
class Result:
    """What a run made."""

    report: dict[str, Any]
    report_path: Path
    cloud: Path | None
    cameras: Path | None
    placed: int
    given: int


@dataclass(frozen=True)
class Mapped:
    """A map that is to be exported, and what is known of the run that made it."""

    state: MapState
    store: Store
    record: RunRecord


def write_result(
    folder: RunFolder,
    mapped: Mapped,
    options: Options,
    stopwatch: Stopwatch,
    publish: Callable[[Path], None],
    progress: ProgressCallback | None,
    cancel: Callable[[], bool] | None,
) -> Result:
    """Make all files beside the earlier ones and hand them to `publish`, which swaps them in.

    Raises what goes wrong, after a report that says so is written: as the folder's report, or beside the earlier
    result, which stays, as `FAILED_REPORTS`. Nothing is written for `Cancelled`.
    """
    with folder.scratch() as made:
        made = made / "files"
        made.mkdir()
        try:
            summary, misfit, is_far = _export(folder, made, mapped, options, stopwatch, progress, cancel)
        except Exception as error:
            if not isinstance(error, Cancelled):
                write_failure(folder, mapped, options, stopwatch, error)
            raise
        report = _write_report(made, REPORTS, folder, summary)
        earlier = [folder.path / name for name in folder.stamp.files if name in ("cloud.laz", "cloud.las")]
        stale = [index for cloud in earlier for index in indexes_of(cloud) if not (made / index.path.name).exists()]
        publish(made)
        for index in stale:  # QGIS would show it instead of the new cloud
            index.remove()
    cloud = summary.cloud.path.name if summary.cloud else None
    try:
        raise_for(summary.placed, summary.given, misfit, is_far, options.export.allow_partial)
    except ReconstructionError as error:
        error.report = folder.path / REPORTS[0]
        raise
    for foreign in indexes_beside(folder.path / cloud) if cloud else ():
        report["warnings"].append(
            f"{foreign.path} was not made from this cloud: QGIS may show it instead; move it away"
        )
    return Result(
        report=report,
        report_path=folder.path / REPORTS[0],
        cloud=folder.path / cloud if cloud else None,
        cameras=folder.path / "cameras.shp",
        placed=summary.placed,
        given=summary.given,
    )


def write_failure(
    folder: RunFolder, mapped: Mapped, options: Options, stopwatch: Stopwatch, error: BaseException
) -> None:
    """Write a report that tells why there are no files; names it in the error. An earlier result stays as it was."""
    text = str(error) if isinstance(error, ReconstructionError) else f"{type(error).__name__}: {error}"
    summary = _summary(mapped, options, stopwatch, None, None, [*mapped.record.warnings], text)
    names = FAILED_REPORTS if folder.is_finished else REPORTS
    with contextlib.suppress(Exception), folder.scratch() as made:  # a second failure must not hide the first
        _write_report(made, names, folder, summary)
        folder.publish(made, FAILURE if folder.is_finished else RESULT)
        if isinstance(error, ReconstructionError):
            error.report = folder.path / names[0]


def _export(
    folder: RunFolder,
    made: Path,
    mapped: Mapped,
    options: Options,
    stopwatch: Stopwatch,
    progress: ProgressCallback | None,
    cancel: Callable[[], bool] | None,
) -> tuple[RunSummary, list[str], bool]:
    """Georeference the map and write its products into `made`; return the misfits too, and whether they are too large.

    What is worst is told first.
    """
    state, record = mapped.state, mapped.record
    reference: GeoReference | None = None
    warnings = list(record.warnings)
    placed, rejected = len(state.frames), len(record.rejections) + len(record.refused)

    def checkpoint(stage: str, done: int, total: int) -> None:
        if cancel is not None and cancel():
            raise Cancelled("stopped on request")
        if progress is not None:
            progress(Progress(stage, done, total, placed, rejected, 0))

    if not state.frames:
        raise ReconstructionError(
            "no photographs could be reconstructed together: they overlap too little or show too little texture; "
            "the report lists what each one lacked"
        )
    with stopwatch.stage("georeference"):
        checkpoint("georeferencing", 0, 1)
        with _solver_errors():
            main = main_part(state)
            poses = {index: main.map_from_cam(index) for index in main.frames}
            up = ground_normal(main)
            stated = main.metres_per_unit
            if options.georeference.local:
                local = local_frame(state.tie, poses, record.shots, options.georeference, up, stated)
                frame = ExportFrame(local.level_from_map, None, local.metric)
                reference = local.reference
                warnings += local.warnings
            else:
                reference = main_reference(state, record.shots, options.georeference, up)
                frame = ExportFrame.of(reference)
            if reference is not None and (said := scale_warning(reference, stated)):
                warnings.append(said)
            state, reference, lost, apart = laid_out(state, record.shots, options.georeference, reference)
            if options.georeference.local:
                reference = None
            record = replace(record, rejections={**record.rejections, **lost})
            mapped = replace(mapped, state=state, record=record)
    with stopwatch.stage("export"):
        view = RunView(
            title=folder.path.resolve().name,
            options=options,
            state=state,
            store=mapped.store,
            shots=record.shots,
            rejections=record.rejections,
            retries=record.retries,
            refused=record.refused,
            reference=reference,
            frame=frame,
            work=made.parent,
            checkpoint=checkpoint,
        )
        products = write_products(made, view)
        drawn, layers = figures(view, made), layers_in(made, products)
    if products.get("far_points"):
        warnings.append(f"{products['far_points']:,} points far outside the survey are left out of all products")
    unread = products["orthophoto"].missing if products.get("orthophoto") else ()
    if unread:
        named = ", ".join(unread[:5])
        warnings.append(f"{len(unread)} photographs could not be read again for the orthophoto: {named}")
    cloud = products.get("cloud")
    given = len(record.shots) + len(record.refused)
    misfit, is_far = misfits(record.details, record.shots, reference)
    attention = [*shortfall(len(state.frames), given), *doubtful_positions(reference)]
    told = [*misfit, *apart, *warnings, *view.dense.warnings()]
    summary = _summary(mapped, options, stopwatch, reference, cloud, told, None)
    details = {**summary.details, "dense_cloud": view.dense.told()} if cloud else summary.details
    unit = "m" if view.frame.metric else "map units"
    return (
        replace(
            summary, unit=unit, details=details, products=products, figures=drawn, layers=layers, attention=attention
        ),
        misfit,
        is_far,
    )


@contextlib.contextmanager
def _solver_errors() -> Iterator[None]:
    """Raise `GeoreferenceError` for the errors of numpy's and scipy's solvers, which say nothing to a user."""
    try:
        yield
    except (
        ValueError,
        ArithmeticError,
        RuntimeError,
    ) as error:  # LinAlgError is a ValueError, SuperLU's a RuntimeError
        raise GeoreferenceError(
            f"the map cannot be tied to its positions ({type(error).__name__}: {error}); 'onthefly3r export' with "
            "--local or other --positions writes it"
        ) from error


def _summary(
    mapped: Mapped,
    options: Options,
    stopwatch: Stopwatch,
    reference: GeoReference | None,
    cloud: CloudSummary | None,
    warnings: list[str],
    error: str | None,
) -> RunSummary:
    record, placed = mapped.record, len(mapped.state.frames)
    given = len(record.shots) + len(record.refused)
    if record.stage != "mapped":
        warnings.append(
            f"the run did not end ({record.error or 'it was stopped'}): this is what was placed by then, "
            f"{placed} of {given} photographs"
        )
    return RunSummary(
        options=options,
        backbone=record.backbone,
        given=given,
        placed=placed,
        rejected=_rejected(record),
        timing=Timing(stopwatch.total_s, stopwatch.stages.get("backbone", 0.0), dict(stopwatch.stages)),
        georeference=reference,
        cloud=cloud,
        error=error,
        warnings=warnings,
        details=record.details,
        backbone_facts=record.backbone_facts,
        stage_memory=stopwatch.memory,
    )


def _write_report(made: Path, names: tuple[str, str], folder: RunFolder, summary: RunSummary) -> dict[str, Any]:
    report = build_report(summary, peak_rss_mib())
    write_report(made / names[0], report)
    write_page(made / names[1], report, folder.path.resolve().name, summary.figures)
    return report


def _rejected(record: RunRecord) -> list[RejectedImage]:
    listed = [RejectedImage(r.name, "intake", r.reason, dict(r.numbers)) for r in record.refused]
    for index, rejection in sorted(record.rejections.items()):
        name = record.shots[index].name
        listed.append(RejectedImage(name, rejection.stage, rejection.reason, dict(rejection.numbers)))
    return listed
