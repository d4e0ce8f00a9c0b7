"""One run from a folder of photographs to the files of the user: the entry of command line, Python and QGIS."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from ..backbones.registry import create_backbone
from ..earth.georef import check_crs, georeference, metres_per_map_unit
from ..earth.ground import ground_normal
from ..engine.loop import Engine
from ..errors import InputError, ReconstructionError
from ..features.extraction import FeatureStore
from ..files.atomic import write_text
from ..intake.images import load_working_image
from ..intake.positions_file import read_positions, with_positions
from ..intake.reading import read_flight
from ..map.journal import shot_from_json, shot_to_json
from ..map.state import MapState
from ..map.store import Store
from ..options import Options, slice_classes
from ..products.clip import require_boundary_near
from ..products.exportframe import ExportFrame
from ..products.las import CloudSummary
from ..products.page import write_page
from ..products.report import RejectedImage, RunSummary, Timing, build_report, write_report
from ..products.runview import RunView
from ..products.writing import remove_products, write_products
from ..protocol import Progress, ProgressCallback
from ..records import GeoReference, RefusedPhotograph, Rejection, Shot
from ..selection.describer import create_describer
from ..stopwatch import Stopwatch, peak_rss_mib

MAX_RUN_FILE_BYTES = 256 * 1024 * 1024
RUN_FILES = ("features", "chunks", "journal.jsonl", "run.json", "crash.txt")  # in OUT/work


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
class _Outcome:
    """The state of affairs that the files and the report are made from."""

    shots: dict[int, Shot]
    rejections: dict[int, Rejection]
    retries: dict[int, int]
    refused: Sequence[RefusedPhotograph]
    backbone: str
    backbone_facts: dict[str, Any]
    details: dict[str, Any]
    warnings: Sequence[str]


def reconstruct(
    photos: Path,
    out: Path,
    options: Options | None = None,
    progress: ProgressCallback | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Result:
    """Reconstruct a folder of photographs into `out`; same names and defaults as the command line.

    Raises:
        InputError: the folder, an option or the environment is wrong; nothing was written.
        ReconstructionError: nothing could be reconstructed or georeferenced; the report is written.
        Cancelled: `cancel` returned true.
    """
    photos, out, options = Path(photos), Path(out), options or Options()
    stopwatch = Stopwatch()
    features = FeatureStore(out / "work" / "features", options.backbone.features, options.backbone.threads)
    backbone = create_backbone(options.backbone, features)
    describer = create_describer(options.selection, features, options.backbone.device)
    with stopwatch.stage("intake"):
        flight = read_flight(photos, options, leave_out=out)
        shots, refused = flight.shots, flight.refused
        check_crs(dict(enumerate(shots)), options.georeference)
        if options.export.boundary is not None:  # a wrong one is told before the work, not after it
            require_boundary_near(Path(options.export.boundary), shots)
    work = _fresh_work_folder(out)
    engine = Engine(
        work,
        options,
        backbone,
        describer,
        lambda shot: load_working_image(shot, options.backbone.working_px, engine.warnings.append),
        progress,
        cancel,
    )
    engine.stopwatch = stopwatch
    engine.warnings += flight.warnings
    with single_threaded_blas():
        engine.add_all(shots)
        engine.finish()
    shutil.rmtree(work / "features", ignore_errors=True)
    write_text(work / "run.json", json.dumps(_run_to_json(engine, backbone.spec.facts(), refused)))
    outcome = _Outcome(
        engine.shots,
        engine.rejections,
        engine.retries,
        refused,
        engine.backbone_name,
        backbone.spec.facts(),
        engine.details(),
        engine.warnings,
    )
    return _finish(out, work, engine.state, engine.store, outcome, options, stopwatch, progress, cancel)


def single_threaded_blas() -> AbstractContextManager[object]:
    """Keep the linear algebra below numpy and scipy to one thread for a while.

    Images and pairs are worked on in several threads already: with more below them, they wait for each other.
    """
    import scipy.linalg  # noqa: F401 - only libraries that are loaded are found
    from threadpoolctl import threadpool_limits

    limits: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limits


def export_again(
    run: Path, out: Path, options: Options | None = None, progress: ProgressCallback | None = None
) -> Result:
    """Write the files of an earlier run again into `out`, with another CRS, format or spacing.

    Raises `InputError` when `run` holds no map, and what `reconstruct` raises.
    """
    run, out, options = Path(run), Path(out), options or Options()
    stopwatch = Stopwatch()
    store = Store(run / "work")
    state = MapState.load(store)
    outcome = _read_run(run / "work" / "run.json")
    if options.georeference.positions is not None:
        file = read_positions(Path(options.georeference.positions))
        placed_anew, told = with_positions([shot for _, shot in sorted(outcome.shots.items())], file)
        shots = dict(zip(sorted(outcome.shots), placed_anew, strict=True))
        outcome = replace(outcome, shots=shots, warnings=[*outcome.warnings, *told])
    check_crs(outcome.shots, options.georeference)
    if options.export.boundary is not None:
        require_boundary_near(Path(options.export.boundary), list(outcome.shots.values()))
    out.mkdir(parents=True, exist_ok=True)
    remove_products(out)
    return _finish(out, out / "work", state, store, outcome, options, stopwatch, progress, None)


def earlier_options(run: Path) -> dict[str, Any]:
    """Return the options of georeferencing and export that an earlier run in `run` was made with, by name.

    Left out are its files: positions stay with the photographs of the run, and a boundary need not be there any more.
    """
    path = Path(run) / "work" / "run.json"
    try:
        if path.stat().st_size > MAX_RUN_FILE_BYTES:
            raise ValueError(f"larger than {MAX_RUN_FILE_BYTES} bytes")
        told = json.loads(path.read_text(encoding="utf-8"))["options"]
        slices = slice_classes()
        names = {item.name for name in ("georeference", "export") for item in fields(slices[name])}
        return {name: told[name] for name in names - {"positions", "boundary", "cloud"} if name in told}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is no record of a run ({error}); name the output folder of a run") from error


def _finish(
    out: Path,
    work: Path,
    state: MapState,
    store: Store,
    outcome: _Outcome,
    options: Options,
    stopwatch: Stopwatch,
    progress: ProgressCallback | None,
    cancel: Callable[[], bool] | None,
) -> Result:
    """Georeference, write the files and, whatever happens, the report."""
    cloud: CloudSummary | None = None
    reference: GeoReference | None = None
    failure: ReconstructionError | None = None
    metres_per_unit: float | None = None
    warnings = list(outcome.warnings)
    placed, rejected = len(state.frames), len(outcome.rejections) + len(outcome.refused)

    def checkpoint(stage: str, done: int, total: int) -> None:
        from ..errors import Cancelled

        if cancel is not None and cancel():
            raise Cancelled("stopped on request; run again to start anew")
        if progress is not None:
            progress(Progress(stage, done, total, placed, rejected, 0))

    try:
        if not state.frames:
            raise ReconstructionError(
                "no photographs could be reconstructed together: they overlap too little or show too little texture; "
                "the report lists what each one lacked"
            )
        with stopwatch.stage("georeference"):
            checkpoint("georeferencing", 0, 1)
            up = ground_normal(state)
            poses = {index: state.map_from_cam(index) for index in state.frames}
            if options.georeference.local:
                metres_per_unit = metres_per_map_unit(poses, outcome.shots, options.georeference)
                if metres_per_unit is None:
                    warnings.append("no positions tell the scale: the units of the local frame are not metres")
            else:
                reference = georeference(poses, outcome.shots, options.georeference, up)
        with stopwatch.stage("export"):
            view = RunView(
                title=out.resolve().name,
                options=options,
                state=state,
                store=store,
                shots=outcome.shots,
                rejections=outcome.rejections,
                retries=outcome.retries,
                refused=outcome.refused,
                reference=reference,
                frame=ExportFrame.of(reference, up, metres_per_unit),
                work=work,
                checkpoint=checkpoint,
            )
            cloud = write_products(out, view).get("cloud")
    except ReconstructionError as error:
        failure = error
    summary = RunSummary(
        options=options,
        backbone=outcome.backbone,
        given=len(outcome.shots) + len(outcome.refused),
        placed=placed,
        rejected=_rejected(outcome),
        timing=Timing(stopwatch.total_s, stopwatch.stages.get("backbone", 0.0), dict(stopwatch.stages)),
        georeference=reference,
        cloud=cloud,
        error=str(failure) if failure else None,
        warnings=warnings,
        details=outcome.details,
        backbone_facts=outcome.backbone_facts,
        stage_memory=stopwatch.memory,
    )
    report = build_report(summary, peak_rss_mib())
    write_report(out / "report.json", report)
    write_page(out / "report.html", report, out.resolve().name)
    if failure is not None:
        raise failure
    return Result(
        report=report,
        report_path=out / "report.json",
        cloud=cloud.path if cloud else None,
        cameras=out / "cameras.shp",
        placed=placed,
        given=summary.given,
    )


def _fresh_work_folder(out: Path) -> Path:
    """Make OUT/work empty, and take away the products of an earlier run so that none can pass for this one's."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder for the results")
    work = out / "work"
    earlier = (out / "report.json").exists() or any((work / name).exists() for name in RUN_FILES)
    if not earlier and out.exists():
        taken = [p.name for p in out.iterdir() if p.name != "work" or any(p.iterdir())]
        if taken:
            raise InputError(f"{out}: is not empty (it holds {taken[0]}) and no earlier result; name another folder")
    remove_products(out)
    if any((work / name).exists() for name in RUN_FILES):
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    return work


def _rejected(outcome: _Outcome) -> list[RejectedImage]:
    listed = [RejectedImage(r.name, "intake", r.reason, dict(r.numbers)) for r in outcome.refused]
    for index, rejection in sorted(outcome.rejections.items()):
        name = outcome.shots[index].name
        listed.append(RejectedImage(name, rejection.stage, rejection.reason, dict(rejection.numbers)))
    return listed


def _run_to_json(
    engine: Engine, backbone_facts: dict[str, Any], refused: Sequence[RefusedPhotograph]
) -> dict[str, Any]:
    return {
        "options": engine.options.to_flat(),
        "backbone": engine.backbone_name,
        "backbone_facts": backbone_facts,
        "details": engine.details(),
        "warnings": list(engine.warnings),
        "shots": {str(i): shot_to_json(shot) for i, shot in engine.shots.items()},
        "retries": {str(i): count for i, count in engine.retries.items()},
        "rejections": {
            str(i): {"stage": r.stage, "reason": r.reason, "numbers": dict(r.numbers)}
            for i, r in engine.rejections.items()
        },
        "refused": [{"name": r.name, "reason": r.reason, "numbers": dict(r.numbers)} for r in refused],
    }


def _read_run(path: Path) -> _Outcome:
    if not path.exists():
        raise InputError(f"{path} is missing: the run did not end; run again")
    if path.stat().st_size > MAX_RUN_FILE_BYTES:
        raise InputError(f"{path} is larger than {MAX_RUN_FILE_BYTES} bytes and not one of ours; run again")
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return _Outcome(
            shots={int(i): shot_from_json(s) for i, s in stored["shots"].items()},
            rejections={
                int(i): Rejection((int(i),), r["stage"], r["reason"], r["numbers"])
                for i, r in stored["rejections"].items()
            },
            retries={int(i): int(n) for i, n in stored["retries"].items()},
            refused=[RefusedPhotograph(r["name"], r["reason"], r["numbers"]) for r in stored["refused"]],
            backbone=str(stored["backbone"]),
            backbone_facts=dict(stored["backbone_facts"]),
            details=dict(stored["details"]),
            warnings=list(stored["warnings"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is damaged ({error!r}); run again") from error
