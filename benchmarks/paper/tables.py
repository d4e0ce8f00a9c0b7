"""The paper's tables in Markdown, measured numbers beside the paper's: `12.3 (11.9)`, the paper's in brackets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from . import published
from .measured import SceneResult

Results = Mapping[str, Mapping[str, SceneResult]]  # method -> scene -> result


def per_scene_table(results: Results) -> str:
    """Return tab:pose_per_scene: ATE (m) of the returned poses in each scene, and coverage (%) over all images."""
    scenes = list(published.OUTDOOR)
    rows = []
    for method in _methods(results, published.POSE_PER_SCENE):
        told = published.POSE_PER_SCENE.get(method, (None,) * 7)
        found = results.get(method, {})
        cells = [beside(_ate(found.get(s)), told[k], 2, method in results) for k, s in enumerate(scenes)]
        coverage = None
        if found:
            coverage = 100.0 * sum(r.placed for r in found.values()) / sum(r.given for r in found.values())
        rows.append([method, *cells, beside(coverage, told[6], 2, bool(found))])
    head = ["Method", *(f"{s} {n}" for s, n in published.OUTDOOR.items()), "Coverage %"]
    return markdown(head, rows)


def macro_table(results: Results) -> str:
    """Return tab:pose_macro: means over the six scenes, on the frames that the common method accepted.

    A method that failed in a scene, or lacks some of the common frames there, has no mean.
    """
    rows = []
    for method in _methods(results, published.POSE_MACRO):
        told = published.POSE_MACRO.get(method, (None,) * 4)
        found = [results.get(method, {}).get(scene) for scene in published.OUTDOOR]
        common = [r.common for r in found if r is not None and r.common is not None]
        complete = len(common) == len(published.OUTDOOR)
        pick: tuple[Callable[..., float | None], ...] = (
            lambda e: e.ate,
            lambda e: e.are_deg,
            lambda e: e.rte_deg,
            lambda e: e.rre_deg,
        )
        means = [mean(p(e) for e in common) if complete else None for p in pick]
        rows.append([method, *(beside(m, t, 2, method in results) for m, t in zip(means, told, strict=True))])
    return markdown(["Method", "ATE m", "ARE deg", "RTE deg", "RRE deg"], rows)


def seven_scenes_table(results: Results) -> str:
    """Return tab:seven_scenes: ATE in centimetres."""
    rows = []
    for method in _methods(results, published.SEVEN_SCENES):
        told = published.SEVEN_SCENES.get(method, (None,) * 8)
        found = results.get(method, {})
        ates = [_ate(found.get(scene)) for scene in published.INDOOR]
        values = [None if a is None else 100.0 * a for a in ates]
        average = mean(values) if all(v is not None for v in values) else None
        cells = [beside(v, t, 2, method in results) for v, t in zip([*values, average], told, strict=True)]
        rows.append([method, *cells])
    return markdown(["Method", *published.INDOOR, "Avg."], rows)


def geometry_table(results: Results) -> str:
    """Return tab:geometry_efficiency: cloud errors and time as means over completed scenes, memory as the peak."""
    rows = []
    for method in _methods(results, published.GEOMETRY_EFFICIENCY):
        told = published.GEOMETRY_EFFICIENCY.get(method)
        found = [r for scene, r in results.get(method, {}).items() if scene in published.OUTDOOR]
        surfaces = [r.surface for r in found if r.surface is not None]
        peaks = [r.peak_gpu_gb for r in found if r.peak_gpu_gb is not None]
        measured = (
            mean(s.accuracy for s in surfaces),
            mean(s.completeness for s in surfaces),
            mean(s.chamfer for s in surfaces),
            mean(r.seconds / r.given for r in found if r.seconds is not None),
            max(peaks, default=None),
        )
        known: tuple[float | None, ...] = (None,) * 5
        if told is not None:
            known = (told.accuracy, told.completeness, told.chamfer, told.s_per_frame, told.peak_gpu_gb)
        scenes = f"{len(surfaces)}/{len(published.OUTDOOR)}" if found else "-"
        cells = [
            beside(m, t, digits, bool(found)) for m, t, digits in zip(measured, known, (2, 2, 2, 3, 2), strict=True)
        ]
        rows.append([method, f"{scenes} ({told.scenes if told else '-'})", *cells])
    return markdown(["Method", "PC scenes", "Acc. m", "Comp. m", "CD m", "Time s/frame", "Peak GPU GB"], rows)


def beside(measured: float | None, told: float | None, digits: int, was_run: bool) -> str:
    """Return `measured (paper)`; a dash for what failed, nothing in front where the method was not run here."""
    paper = "OOM" if told == math.inf else shown(told, digits)
    return f"{shown(measured, digits)} ({paper})" if was_run else f"({paper})"


def shown(value: float | None, digits: int = 2) -> str:
    """Return a figure for a table, a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of what is known, None for nothing."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _methods(results: Results, told: Mapping[str, object]) -> list[str]:
    """The paper's methods in its order, then those that only were measured."""
    return [*told, *(method for method in results if method not in told)]


def _ate(result: SceneResult | None) -> float | None:
    return None if result is None or result.errors is None else result.errors.ate
