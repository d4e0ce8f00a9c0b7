"""The command line: run, resume, batch, check, export, evaluate, simulate, demo, doctor, view.

Exit codes: 0 done, 2 the input is wrong, 3 nothing reconstructed or georeferenced, 4 no room or no access,
5 fewer than half of the photographs placed, 130 cancelled, 1 unexpected.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .. import __version__
from ..errors import InputError, ReconstructionError
from ..evaluate.comparison import CloudAlign
from ..evaluate.trajectory_errors import Align
from ..options import over_earlier
from ..protocol import Job
from ..simulate.flight import SurveyOptions
from .console import columns, session, use_utf8
from .option_parameters import given, run_options, with_options_of, with_run_options

if TYPE_CHECKING:
    from ..run.result import Result
    from .demo import Demo

app = typer.Typer(
    help="Georeferenced point clouds from drone photographs while they arrive.",
    context_settings={"help_option_names": ["-h", "--help"]},
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

JsonLines = Annotated[
    bool, typer.Option("--json", help="print one JSON object per line instead of a progress bar", show_default=False)
]
Out = Annotated[Path, typer.Argument(metavar="OUT", help="output folder; it is made")]


def _print_version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit()


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="print the version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


@app.command()
@with_run_options()
def run(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="folder of photographs")],
    out: Out,
    anew: Annotated[
        bool,
        typer.Option("--anew", help="begin again instead of going on with a run that did not end", show_default=False),
    ] = False,
    json: JsonLines = False,
    **values: Any,
) -> None:
    """Reconstruct a folder of photographs: cloud, cameras and report in OUT; a run that did not end goes on."""
    with session(json_lines=json, out=out) as here:
        options = run_options(values)
        _require_folder(photos, "PHOTOS")
        from ..run.session import reconstruct

        result = reconstruct(photos, out, options, here.progress, here.cancelled, anew)
        for warning in result.report.get("warnings", ()):
            here.warning(warning)
        here.result(_result_data(result), columns(_result_summary(result)))


@app.command()
@with_run_options()
def resume(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a run that did not end")],
    json: JsonLines = False,
    **values: Any,
) -> None:
    """Go on with a run that was stopped or killed, from where it was; its options stay but for those named."""
    with session(json_lines=json, out=out) as here:
        _require_folder(out, "OUT")
        from ..run.session import resume as resume_run

        result = resume_run(out, given(values), here.progress, here.cancelled)
        for warning in result.report.get("warnings", ()):
            here.warning(warning)
        here.result(_result_data(result), columns(_result_summary(result)))


@app.command()
@with_run_options()
def batch(
    flights: Annotated[
        Path,
        typer.Argument(
            metavar="FLIGHTS",
            help="folder whose sub-folders are flights, or a CSV with the columns photos, name, options",
        ),
    ],
    out: Out,
    skip_done: Annotated[
        bool, typer.Option("--skip-done", help="leave flights alone that were done before", show_default=False)
    ] = False,
    json: JsonLines = False,
    **values: Any,
) -> None:
    """Reconstruct many flights, each into a folder of its own in OUT; one that fails does not stop the others."""
    with session(json_lines=json, out=out) as here:
        options = run_options(values)
        from .batch import read_flights, reconstruct_flights

        rows = reconstruct_flights(
            read_flights(flights, leave_out=out), out, options, skip_done, here.progress, here.cancelled
        )
        data = {"table": str(out / "flights.csv"), "flights": [asdict(row) for row in rows]}
        here.result(data, columns({row.flight: f"{row.status} {row.message}".strip() for row in rows}))
        failed = [row.flight for row in rows if row.status == "failed"]
        if failed:
            raise ReconstructionError(f"{len(failed)} of {len(rows)} flights failed: {', '.join(failed)}")


@app.command()
@with_run_options()
def check(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="folder of photographs")],
    out: Out,
    above_ground_m: Annotated[
        float | None,
        typer.Option(
            help="flying height; default: what the drone states, else measured between photographs",
            metavar="m",
            min=0.1,
        ),
    ] = None,
    json: JsonLines = False,
    **values: Any,
) -> None:
    """Look at photographs before they are processed: positions, overlap, blur, exposure, tags, time and memory."""
    with session(json_lines=json, out=out) as here:
        options = run_options(values)
        _require_folder(photos, "PHOTOS")
        from ..files.owned import OwnedFolder
        from .check import CHECK_FILES, check_photographs, write_check

        OwnedFolder.require(out, CHECK_FILES, guest=True)
        checked = check_photographs(photos, options, above_ground_m, here.progress, here.cancelled)
        summary = checked.summary()
        for warning in summary["warnings"]:
            here.warning(warning)
        data = {"check": str(write_check(out, checked)), **summary}
        here.result(data, columns({name: str(value) for name, value in data.items() if name != "warnings"}))


@app.command()
@with_run_options("georeference", "export")
def export(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="output folder of an earlier run")],
    out: Out,
    partial: Annotated[
        bool,
        typer.Option("--partial", help="of a run whose files are damaged, write what is not", show_default=False),
    ] = False,
    json: JsonLines = False,
    **values: Any,
) -> None:
    """Write the files of an earlier run again into OUT; what is not named stays as it was in that run."""
    with session(json_lines=json, out=out) as here:
        _require_folder(result, "RESULT")
        from ..run.export import export as export_run
        from ..run.record import earlier_options

        options = run_options(over_earlier(earlier_options(result), given(values)))
        again = export_run(result, out, options, here.progress, partial)
        for warning in again.report.get("warnings", ()):
            here.warning(warning)
        here.result(_result_data(again), columns(_result_summary(again)))


@app.command()
def evaluate(
    result: Annotated[
        Path, typer.Argument(metavar="RESULT", help="output folder of a run, or a file of poses or points")
    ],
    reference_poses: Annotated[
        Path | None,
        typer.Option(
            help="COLMAP model, trajectory table (CSV), TUM, KITTI, transforms.json, npz, or output folder",
            metavar="path",
        ),
    ] = None,
    reference_cloud: Annotated[
        Path | None, typer.Option(help="LAS, LAZ or PLY cloud, or output folder", metavar="path")
    ] = None,
    align: Annotated[
        Align,
        typer.Option(help="fitted to the camera centres before poses are compared: sim3, se3 or none", metavar="word"),
    ] = "sim3",
    cloud_align: Annotated[
        CloudAlign,
        typer.Option(
            help="none compares clouds as they lie, poses moves the result by the cameras' fit", metavar="word"
        ),
    ] = "none",
    common_with: Annotated[
        list[Path] | None,
        typer.Option(help="further results: adds the errors over the images that all hold", metavar="path"),
    ] = None,
    icp: Annotated[bool, typer.Option("--icp", help="refine the clouds' alignment (needs the extra cloud)")] = False,
    ground_cell_m: Annotated[
        float | None, typer.Option(help="also compare heights over a grid of this cell", metavar="m", min=0.001)
    ] = None,
    json: JsonLines = False,
) -> None:
    """Compare a result with reference poses, a reference cloud, or both."""
    with session(json_lines=json, polite=False) as here:
        from ..evaluate.comparison import evaluate, format_table

        report = evaluate(
            result,
            reference_poses,
            reference_cloud,
            align=align,
            common_with=common_with or (),
            cloud_align=cloud_align,
            icp=icp,
            ground_cell_m=ground_cell_m,
        )
        here.result(report.to_dict(), format_table(report))


@app.command()
@with_options_of(SurveyOptions, "Survey")
def simulate(out: Out, json: JsonLines = False, **values: Any) -> None:
    """Render a made-up survey: photographs with tags in OUT/photos, the truth in OUT/truth."""
    with session(json_lines=json, out=out) as here:
        options = SurveyOptions(**given(values))
        from ..simulate import simulate_survey

        survey = simulate_survey(out, options, here.progress)
        data = {"photos": str(out / "photos"), "truth": str(out / "truth"), "given": len(survey.views)}
        here.result(data, columns({name: str(value) for name, value in data.items()}))


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder; it is made")] = Path("demo-survey"),
    json: JsonLines = False,
) -> None:
    """Render a small survey, reconstruct its photographs, and say how far the result is from the truth."""
    with session(json_lines=json, out=out) as here:
        from .demo import run_demo

        shown = run_demo(out, here.progress, here.cancelled)
        here.result(
            {**_result_data(shown.result), "accuracy": asdict(shown.accuracy)},
            columns({**_result_summary(shown.result), **_demo_summary(shown)}),
        )


@app.command()
def view(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="LAS or LAZ cloud, or the output folder of a run")],
) -> None:
    """Show a cloud in a window (needs the extra cloud)."""
    with session(json_lines=False, polite=False):
        from .viewer import view_cloud

        view_cloud(cloud)


@app.command()
def backbones(
    json: Annotated[bool, typer.Option("--json", help="print one JSON object", show_default=False)] = False,
) -> None:
    """List the local reconstructors, what each needs here, and what to do next."""
    from ..backbones.listing import backbones_json, backbones_text

    with session(json_lines=False, polite=False):
        print(backbones_json() if json else backbones_text())


@app.command()
def doctor(
    json: Annotated[bool, typer.Option("--json", help="print one JSON object", show_default=False)] = False,
) -> None:
    """Check the interpreter, its packages and the machine, and say how to mend what is missing."""
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    from .doctor import examine, is_fit, to_json

    checks = examine(Path.cwd())
    if json:
        print(to_json(checks))
    else:
        table = Table("", *(Column(name, overflow="fold") for name in ("check", "found", "to mend it")), box=None)
        for check in checks:
            colour = {"ok": "green", "note": "yellow", "missing": "red"}[check.status]
            table.add_row(Text(check.status, colour), check.name, Text(check.found), Text(check.remedy))
        Console(highlight=False).print(table)
    raise typer.Exit(0 if is_fit(checks) else InputError.exit_code)


@app.command()
def job(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="JSON file with verb, arguments and options")],
) -> None:
    """Run the command that another program wrote into a file, with JSON lines as with --json."""
    with session(json_lines=True, polite=False):
        words = Job.read(file).words()
    app(words, prog_name="onthefly3r")


def main() -> None:
    """Run the command line; the entry point of the console script."""
    use_utf8()
    app(prog_name="onthefly3r")


def _require_folder(path: Path, name: str) -> None:
    if not path.is_dir():
        found = "is a file" if path.exists() else "does not exist"
        raise InputError(f"{name} {path} {found}: name a folder")


def _result_data(result: Result) -> dict[str, Any]:
    """Return the data of a result event: paths and the counts; the figures are in the report."""
    paths = {"cloud": result.cloud, "cameras": result.cameras, "report": result.report_path}
    return {
        **{name: None if path is None else str(path) for name, path in paths.items()},
        "placed": result.placed,
        "given": result.given,
    }


def _demo_summary(demo: Demo) -> dict[str, str]:
    """Return how far the demonstration is from the truth, and where its pictures are."""
    a = demo.accuracy
    return {
        "preview": str(demo.out / "result" / "preview.png"),
        "photographs": str(demo.out / "photos"),
        "truth": str(demo.out / "truth"),
        "camera error": f"{a.ate_m:.3f} m, {a.ate_percent:.2f} % of the flying height (ATE), "
        f"{a.are_deg:.3f} degrees (ARE), {a.cameras} cameras",
        "on the ground": f"{a.camera_absolute_h_m:.3f} m horizontally, {a.camera_absolute_v_m:.3f} m vertically",
        "cloud error": f"{a.cloud_fitted_m:.3f} m to the true surface, {a.cloud_fitted_gsd:.2f} GSD "
        f"(GSD {a.gsd_m:.3f} m); {a.cloud_absolute_m:.3f} m as georeferenced",
    }


def _result_summary(result: Result) -> dict[str, str]:
    """Return what a person wants to know first, by name."""
    report = result.report
    summary = {"placed": f"{result.placed} of {result.given} photographs"}
    georeference, cloud, timing = report.get("georeference"), report.get("cloud"), report.get("timing")
    if georeference:
        summary["CRS"] = f"{georeference['crs']}, heights {georeference['vertical']}"
        if georeference.get("rmse_h_m") is not None:
            rmse = f"{georeference['rmse_h_m']:.2f} m horizontally, {georeference['rmse_v_m']:.2f} m vertically"
            summary["positions"] = f"{georeference['n_used']} used, residuals {rmse} (RMS, not the accuracy)"
    if cloud:
        summary["points"] = f"{cloud['points']:,}, {cloud['mean_spacing']:.3f} {cloud['unit']} apart"
    if timing:
        summary["time"] = f"{timing['total_s']:.0f} s, {timing['per_image_s']:.2f} s per photograph"
    for name, path in (("cloud", result.cloud), ("cameras", result.cameras), ("report", result.report_path)):
        if path is not None:
            summary[name] = str(path)
    return summary
