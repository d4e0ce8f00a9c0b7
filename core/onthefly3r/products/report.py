"""`report.json`: what went in, what came out, how well, how fast."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import __version__
from ..files.atomic import write_text
from ..options import Options
from ..records import GeoReference
from .accuracy import accuracy_report
from .las import CloudSummary
from .reportfigures import Figure, facts_of


@dataclass(frozen=True)
class RejectedImage:
    """A photograph that is not in the result, the stage that refused it last and why."""

    image: str
    stage: str
    reason: str
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Timing:
    """Where the time went; own time is everything but the backbone."""

    total_s: float
    backbone_s: float
    stages: Mapping[str, float] = field(default_factory=dict)  # s


@dataclass(frozen=True)
class RunSummary:
    """All that the report is made from; None where a run did not get that far."""

    options: Options
    backbone: str
    given: int  # photographs found
    placed: int
    rejected: Sequence[RejectedImage]
    timing: Timing
    georeference: GeoReference | None = None
    cloud: CloudSummary | None = None
    products: Mapping[str, Any] = field(default_factory=dict)  # what `writing.write_products` returned
    figures: Sequence[Figure] = ()  # of the page
    layers: Sequence[Mapping[str, Any]] = ()  # as `catalogue.layers_in` returns them
    error: str | None = None  # why the run ended early
    attention: Sequence[str] = ()  # what must be known before anything else, see `run.verdict`
    warnings: Sequence[str] = ()
    details: Mapping[str, Any] = field(default_factory=dict)  # further figures, JSON values
    backbone_facts: Mapping[str, Any] = field(default_factory=dict)  # name, version, licence, weights
    unit: str = "m"  # of the cloud's coordinates: a local frame without scale has map units
    stage_memory: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # peaks by stage, MiB


def build_report(run: RunSummary, peak_rss_mib: float | None) -> dict[str, Any]:
    """Return the report as JSON values: numbers that are not finite become None, paths their file name."""
    geo, cloud, timing = run.georeference, run.cloud, run.timing
    report: dict[str, Any] = {
        "software": {
            "version": __version__,
            "backbone": run.backbone,
            "options": run.options.to_flat(),
            "command": _command(run.options),
        },
        "backbone": dict(run.backbone_facts),
        "images": {
            "given": run.given,
            "placed": run.placed,
            "rejected": [
                {"image": r.image, "stage": r.stage, "reason": r.reason, "numbers": dict(r.numbers)}
                for r in run.rejected
            ],
        },
        "georeference": None
        if geo is None
        else {
            "crs": geo.crs,
            "vertical": geo.vertical,
            "scale": geo.enu_from_map.scale,
            "n_used": geo.n_used,
            "n_outliers": geo.n_outliers,
            "rmse_h_m": geo.rmse_h_m,
            "rmse_v_m": geo.rmse_v_m,
            "method": geo.method,
        },
        "accuracy": None if geo is None else accuracy_report(geo),
        "cloud": None
        if cloud is None
        else {
            "path": cloud.path.name,
            "points": cloud.points,
            "bounds": list(cloud.bounds),
            "mean_spacing_m": cloud.mean_spacing_m if run.unit == "m" else None,
            "mean_spacing": cloud.mean_spacing_m,
            "unit": run.unit,
        },
        **facts_of(run.products),
        "layers": [dict(layer) for layer in run.layers],
        "timing": {
            "total_s": timing.total_s,
            "per_image_s": timing.total_s / run.given if run.given else None,
            "stages": dict(timing.stages),
            "backbone_s": timing.backbone_s,
            "own_s": timing.total_s - timing.backbone_s,
        },
        "memory": {"peak_rss_mib": peak_rss_mib, "stages": dict(run.stage_memory)},
        "error": run.error,
        "attention": list(run.attention),
        "warnings": [*run.attention, *run.warnings, *(geo.warnings if geo else ())],
        "details": dict(run.details),
    }
    return dict(_plain(report))


def _command(options: Options) -> str:
    """Return the command line that gives the same options."""
    words = ["onthefly3r", "run", "PHOTOS", "OUT"]
    for name, value in sorted(options.to_named().items()):
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif value is not None:
            words += [f"--{flag}", shlex.quote(str(value))]
    return " ".join(words)


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write the report as strict JSON (no NaN), UTF-8, atomically."""
    text = json.dumps(_plain(report), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)
