"""`report.html`: the report as a page for people, one file beside the preview picture."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ..files.atomic import write_text
from .reportfigures import Figure
from .trafficlights import WORDS, lights, sentence

STYLE = """
body { font: 15px/1.5 sans-serif; margin: 2em auto; max-width: 60em; padding: 0 1em; color: #1d2126; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 1.8em; }
table { border-collapse: collapse; } td, th { padding: .2em 1em .2em 0; text-align: left; vertical-align: top; }
th { border-bottom: 1px solid #aab; } .note { color: #566; } .bad { color: #a61b1b; }
img { max-width: 100%; border: 1px solid #ccd; } svg { max-width: 100%; border: 1px solid #ccd; background: #f4f5f7; }
svg.small { width: 18em; } .row { display: flex; flex-wrap: wrap; gap: 1em; } figure { margin: 0; max-width: 20em; }
figcaption { color: #566; font-size: .9em; overflow-wrap: anywhere; } code { overflow-wrap: anywhere; }
.verdict { font-size: 1.2em; } .light { display: inline-block; width: .9em; height: .9em; border-radius: 50%; }
.green { background: #1a9850; } .amber { background: #f9a825; } .red { background: #c62828; }
.grey { background: #aab; }
.placed { fill: #2dd4eb; stroke: #181a1e; } .rejected { stroke: #ff5252; stroke-width: 3; fill: none; }
.arrow { stroke: #ffe000; stroke-width: 2; fill: none; } .bar { fill: #4a6fa5; }
@media print { body { margin: 0; max-width: none; } figure, table, svg { break-inside: avoid; } }
"""

# What helps when a stage refuses photographs; shown once per stage that did.
REMEDIES = {
    "intake": "The file is no usable photograph: damaged, too small, or twice the same.",
    "seed": "Too few photographs show the same ground. More overlap is needed (about 70 % along, 60 % across).",
    "retrieval": "No placed photograph looks alike. Photographs of the ground between them are missing.",
    "backbone": "Too few common details: water, snow, uniform fields, motion blur, or too little overlap.",
    "alignment": "The photograph fits its neighbours, but they do not fit the map: often repeating patterns.",
    "references": "The photographs it was compared with moved too much: often repeating patterns.",
    "fragments": "Reconstructed, but apart from the rest, and without positions that tell where.",
    "queries": "The place that was found contradicts what the map shows: often repeating patterns.",
}
GEOID = {
    "ellipsoidal": "above the WGS 84 ellipsoid",
    "egm96": "above the EGM96 geoid",
    "egm2008": "above the EGM2008 geoid",
}


def write_page(path: Path, report: Mapping[str, Any], title: str, drawn: Sequence[Figure] = ()) -> None:
    """Write the page of a report as `report.build_report` makes it."""
    picture = path.parent / "preview.png"
    encoded = base64.b64encode(picture.read_bytes()).decode("ascii") if picture.is_file() else None
    write_text(path, page(report, title, encoded, drawn))


def page(report: Mapping[str, Any], title: str, preview: str | None, drawn: Sequence[Figure] = ()) -> str:
    """Return the whole page in one file; everything that comes from photographs is escaped.

    Args:
        report: as `report.build_report` makes it.
        title: of the page.
        preview: the preview picture, PNG in base 64, where there is one.
        drawn: figures, whose HTML is escaped already.
    """
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
    ]
    if report["error"]:
        parts.append(f'<p class="bad">{escape(report["error"])}</p>')
    else:
        parts += _verdict(report)
    parts += [f'<p class="bad">{escape(text)}</p>' for text in report["attention"]]
    parts.append(_table(_summary(report)))
    if preview and not report["error"] and not drawn:
        parts.append(f'<p><img src="data:image/png;base64,{preview}" alt="The cloud from above with the cameras"></p>')
    if report["warnings"]:
        parts.append("<h2>Warnings</h2><ul>" + "".join(f"<li>{escape(w)}</li>" for w in report["warnings"]) + "</ul>")
    for figure in drawn:
        parts.append(f"<h2>{escape(figure.heading)}</h2>{figure.html}")
        if figure.note:
            parts.append(f'<p class="note">{escape(figure.note)}</p>')
    parts += _georeference(report["georeference"])
    parts += _rejected(report["images"]["rejected"])
    parts += _timing(report)
    parts += _backbone(report["backbone"])
    parts.append("<h2>Options</h2>" + _table([(n, _text(v)) for n, v in report["software"]["options"].items()]))
    command = report["software"].get("command")
    if command:
        parts.append(f"<h2>The command that repeats it</h2><p><code>{escape(command)}</code></p>")
    version, backbone = report["software"]["version"], report["software"]["backbone"]
    parts.append(f'<p class="note">On-the-Fly3R {escape(version)}, backbone {escape(backbone)}</p></body></html>')
    return "\n".join(parts) + "\n"


def _verdict(report: Mapping[str, Any]) -> list[str]:
    rows = "".join(
        f'<tr><td><span class="light {light.colour}"></span></td><td>{escape(light.name)}</td>'
        f"<td>{WORDS[light.colour]}</td><td>{escape(light.text)}</td></tr>"
        for light in lights(report)
    )
    return [f'<p class="verdict">{escape(sentence(report))}</p>', f"<table>{rows}</table>"]


def _summary(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    images, geo, cloud = report["images"], report["georeference"], report["cloud"]
    rows = [("Photographs placed", f"{images['placed']} of {images['given']}")]
    if geo:
        rows.append(("Coordinates", f"{geo['crs']}, heights {GEOID.get(geo['vertical'], 'as in the tags')}"))
    elif cloud:
        rows.append(("Coordinates", "local, without a coordinate reference system"))
    if cloud:
        rows.append(("Points", f"{cloud['points']:,}"))
        rows.append(("Mean distance of points", f"{_number(cloud['mean_spacing'], 3)} {cloud['unit']}"))
    return rows


def _georeference(geo: Mapping[str, Any] | None) -> list[str]:
    if not geo:
        return []
    return [
        "<h2>Georeferencing</h2>",
        _table(
            [
                ("Positions used", f"{geo['n_used']}, {geo['n_outliers']} set aside as outliers"),
                ("Residuals, horizontal (RMS)", f"{_number(geo['rmse_h_m'], 3)} m"),
                ("Residuals, vertical (RMS)", f"{_number(geo['rmse_v_m'], 3)} m"),
                ("Method", geo["method"]),
            ]
        ),
        '<p class="note">Residuals say how well the map fits the positions in the photographs. They are not the '
        "accuracy of the map: that needs independent checkpoints.</p>",
    ]


def _rejected(rejected: Sequence[Mapping[str, Any]]) -> list[str]:
    if not rejected:
        return ["<h2>Rejected photographs</h2>", "<p>None.</p>"]
    rows = "".join(
        f"<tr><td>{escape(r['image'])}</td><td>{escape(r['stage'])}</td><td>{escape(r['reason'])}</td></tr>"
        for r in rejected
    )
    stages = dict.fromkeys(r["stage"] for r in rejected)
    help_rows = [(stage, REMEDIES[stage]) for stage in stages if stage in REMEDIES]
    return [
        f"<h2>Rejected photographs ({len(rejected)})</h2>",
        f"<table><tr><th>photograph</th><th>stage</th><th>reason</th></tr>{rows}</table>",
        *([f"<h3>What the stages mean</h3>{_table(help_rows)}"] if help_rows else []),
    ]


def _timing(report: Mapping[str, Any]) -> list[str]:
    timing, peak = report["timing"], report["memory"]["peak_rss_mib"]
    rows = [("Total", f"{_number(timing['total_s'], 1)} s")]
    if timing["per_image_s"] is not None:
        rows.append(("Per photograph", f"{_number(timing['per_image_s'], 2)} s"))
    rows += [(name, f"{_number(seconds, 1)} s") for name, seconds in timing["stages"].items()]
    if peak is not None:
        rows.append(("Most memory", f"{peak:.0f} MiB"))
    on_gpu = {name: used["peak_gpu_mib"] for name, used in report["memory"]["stages"].items() if "peak_gpu_mib" in used}
    rows += [(f"Most GPU memory, {name}", f"{used:.0f} MiB") for name, used in on_gpu.items()]
    return ["<h2>Time and memory</h2>", _table(rows)]


def _backbone(facts: Mapping[str, Any]) -> list[str]:
    """Name what made the local models, and under which licence: it may bind what the result is used for."""
    if not facts:
        return []
    rows = [("Name", facts["name"]), ("Licence", facts["licence"])]
    weights = facts["weights"]
    if weights:
        rows.append(("Weights", f"{facts['version']}: {weights['file']}, {weights['bytes']:,} bytes"))
        rows.append(("SHA-256 of the weights", weights["sha256"]))
    return ["<h2>Backbone</h2>", _table(rows)]


def _table(rows: Sequence[tuple[str, str]]) -> str:
    return "<table>" + "".join(f"<tr><td>{escape(n)}</td><td>{escape(v)}</td></tr>" for n, v in rows) + "</table>"


def _number(value: float | None, digits: int) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}"


def _text(value: object) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else "" if value is None else str(value)
