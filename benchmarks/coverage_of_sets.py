"""How many photographs are placed, how well, and how many wrongly, on sets with gaps and on thinned ones.

A set is a folder with photos/ and reference/, and perhaps reference_pp/free, where the principal point is free as it
is in our runs; that one is then the reference. `FOLDER:second` takes every second photograph of it, `FOLDER:belt`
leaves out a belt across the flight, but for two photographs that tie the halves. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_peer import SUFFIXES, photos_of, run_ours, shown
from onthefly3r.evaluate.poses import PoseSet, match
from onthefly3r.evaluate.readers import read_poses, scene_depth
from onthefly3r.evaluate.trajectory_errors import alignment
from onthefly3r.geometry.umeyama import weighted_similarity

WRONG_SHARE = 0.03  # of the flying height
BELT_DEPTHS = 0.9  # how wide the belt is, in flying heights: about the width of a photograph on the ground
TYING = 2  # photographs in the belt that stay
REWEIGHTED = 20  # rounds of the fit that wrong cameras do not bend
ORDERS = {"capture": [], "shuffled": ["--shuffle-seed", "3"]}


@dataclass(frozen=True)
class Reference:
    """Cameras to compare with, and the flying height in their unit."""

    poses: PoseSet
    depth: float


def read_reference(folder: Path) -> Reference:
    """Return the reference of a set: that with the principal point free, if there is one."""
    held = read_poses(folder / "reference")
    depth = scene_depth(folder / "reference")
    if depth is None:
        raise SystemExit(f"{folder / 'reference'}: summary.json with median_scene_depth is missing")
    if not (folder / "reference_pp" / "free").is_dir():
        return Reference(held, depth)
    free = read_poses(folder / "reference_pp" / "free")
    rows, others = match(held, free)
    return Reference(free, depth * alignment(held.take(rows), free.take(others), "sim3").scale)


def thinned(folder: Path, how: str, reference: Reference, work: Path) -> Path:
    """Return a folder with those photographs of a set that are left: every second, or all outside the belt."""
    photos = photos_of(folder)
    names = sorted(p.relative_to(photos).as_posix() for p in photos.rglob("*") if p.suffix.lower() in SUFFIXES)
    kept = names[::2] if how == "second" else sorted({*names} - belt(reference))
    for name in kept:
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(photos / name, work / name)
    return work


def belt(reference: Reference) -> set[str]:
    """Return the photographs across the middle of the flight, but for the two nearest to where it is widest."""
    centres = reference.poses.centres - np.median(reference.poses.centres, axis=0)
    along, across, _ = np.linalg.svd(centres, full_matrices=False)[2]
    inside = np.flatnonzero(np.abs(centres @ along) < BELT_DEPTHS / 2 * reference.depth)
    away = np.hypot(centres[inside] @ along, centres[inside] @ across - np.median(centres[inside] @ across))
    left_out = inside[np.argsort(away)[TYING:]]
    return {reference.poses.names[k] for k in left_out}


def robust_errors(estimate: PoseSet, reference: PoseSet) -> np.ndarray:
    """Return how far cameras (N,) are off after a fit that those far off do not bend (least absolute distances)."""
    rows, others = match(estimate, reference)
    found, truth = estimate.centres[rows], reference.centres[others]
    weight = np.ones(len(rows))
    for _ in range(REWEIGHTED):
        distance = np.linalg.norm(weighted_similarity(found, truth, weight).apply(found) - truth, axis=1)
        weight = 1.0 / np.maximum(distance, 1e-3 * distance.max())
    return np.asarray(distance)


def measure(wanted: str, order: str, work: Path, options: list[str]) -> dict[str, object]:
    """Run ours on a set in one order and return its row."""
    name, _, how = wanted.partition(":")
    folder = Path(name)
    reference = read_reference(folder)
    work.mkdir(parents=True)
    photos = thinned(folder, how, reference, work / "photos") if how else photos_of(folder)
    given = sum(path.suffix.lower() in SUFFIXES for path in photos.rglob("*"))
    ran = run_ours(photos, work, [*options, *ORDERS[order]])
    row = {"set": folder.name + (f", {how}" if how else ""), "order": order, "given": given, **ran}
    if "placed" in ran:
        off = robust_errors(read_poses(work / "ours"), reference.poses) / reference.depth
        good = off[off <= WRONG_SHARE]
        report = json.loads((work / "ours" / "report.json").read_text(encoding="utf-8"))
        row |= {
            "compared": len(off),
            "ate_percent": 100.0 * float(np.sqrt(np.mean(off**2))),
            "ate_right_percent": 100.0 * float(np.sqrt(np.mean(good**2))) if len(good) else None,
            "wrong": int((off > WRONG_SHARE).sum()),
            "details": report.get("details", {}),
        }
    return row


def table(rows: list[dict[str, object]]) -> str:
    """Return the rows as a table in Markdown."""
    lines = [
        "| set | order | placed | compared | ATE % | ATE % of the right ones | wrong | CPU s | exit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [
            row["set"],
            row["order"],
            f"{row.get('placed', 0)} of {row['given']}",
            row.get("compared", "-"),
            shown(row.get("ate_percent"), 3),  # type: ignore[arg-type]
            shown(row.get("ate_right_percent"), 3),  # type: ignore[arg-type]
            row.get("wrong", "-"),
            shown(row["cpu_s"], 0),  # type: ignore[arg-type]
            row["exit_status"],
        ]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def main() -> int:
    """Measure what the command line names and print the table; 1 where a photograph was placed wrongly."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", help="FOLDER, FOLDER:second or FOLDER:belt")
    parser.add_argument("--orders", nargs="+", choices=list(ORDERS), default=list(ORDERS))
    parser.add_argument("--work", type=Path, default=Path("coverage-work"), help="scratch folder; it must be new")
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[], help="what follows goes to `onthefly3r run`")
    chosen = parser.parse_args()
    if chosen.work.exists():
        parser.error(f"{chosen.work} exists: name a new folder for --work")
    rows = []
    for wanted in chosen.sets:
        for order in chosen.orders:
            scratch = chosen.work / f"{Path(wanted).name.replace(':', '-')}-{order}"
            rows.append(measure(wanted, order, scratch, chosen.options))
            print(table(rows[-1:]), flush=True)
            (chosen.work / "figures.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print("\n" + table(rows))
    return int(any(row.get("wrong") for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
