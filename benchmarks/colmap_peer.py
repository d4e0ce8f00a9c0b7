"""Time a whole run of ours against a whole run of pycolmap on the same photographs, one after the other.

Ours counts everything from the start of the process to its end: dense point maps, georeferencing, files.
pycolmap counts its reconstruction of the cameras alone: SIFT (6,000 features at 1600 px), exhaustive matching,
incremental mapping. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}

# Runs in a process of its own: its wall time and peak memory are then pycolmap's alone.
PEER = """
import json, sys, time, zlib
import pycolmap
photos, work, threads = sys.argv[1], sys.argv[2], int(sys.argv[3])
pycolmap.logging.minloglevel = 2
database = work + "/database.db"
seconds, began = {}, time.perf_counter()
def lap(name):
    global began
    now = time.perf_counter()
    seconds[name], began = now - began, now
reader = pycolmap.ImageReaderOptions()
reader.camera_model = "OPENCV"
extraction = pycolmap.FeatureExtractionOptions()
extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, threads, 1600
extraction.sift.max_num_features = 6000
pycolmap.extract_features(
    database, photos, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, extraction_options=extraction
)
lap("extraction_s")
matching = pycolmap.FeatureMatchingOptions()
matching.use_gpu, matching.num_threads = False, threads
pycolmap.match_exhaustive(database, matching_options=matching)
lap("matching_s")
mapping = pycolmap.IncrementalPipelineOptions()
mapping.num_threads = threads
models = pycolmap.incremental_mapping(database, photos, work, options=mapping)
lap("mapping_s")
placed = max((model.num_reg_images() for model in models.values()), default=0)
with open(work + "/timing.json", "w") as stream:
    json.dump({"seconds": seconds, "placed": placed}, stream)
"""


def photos_of(folder: Path) -> Path:
    """Return the folder that holds the photographs: a data folder's photos/, or the folder itself."""
    return folder / "photos" if (folder / "photos").is_dir() else folder


def count_photographs(photos: Path) -> int:
    """Return how many photographs a folder holds, sub-folders included."""
    return sum(path.suffix.lower() in SUFFIXES for path in photos.rglob("*"))


def timed(command: list[str], log: Path) -> tuple[float, int]:
    """Run a command with its output in `log`; return wall seconds and exit status."""
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as stream:
        status = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, check=False).returncode
    return time.perf_counter() - began, status


def run_ours(photos: Path, work: Path, options: list[str]) -> dict[str, Any]:
    """Run the command line on the photographs."""
    out = work / "ours"
    command = [sys.executable, "-m", "onthefly3r", "run", str(photos), str(out), "--json", *options]
    wall_s, status = timed(command, work / "ours.log")
    row: dict[str, Any] = {"wall_s": wall_s, "exit_status": status}
    if (out / "report.json").is_file():
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
        row["placed"] = report["images"]["placed"]
        row["memory_mib"] = report.get("memory", {}).get("peak_rss_mib")
        row["timing"] = report["timing"]
    return row


def run_peer(photos: Path, work: Path, threads: int) -> dict[str, Any]:
    """Run pycolmap on the same photographs."""
    scratch = work / "peer"
    scratch.mkdir()
    wall_s, status = timed([sys.executable, "-c", PEER, str(photos), str(scratch), str(threads)], work / "peer.log")
    row: dict[str, Any] = {"wall_s": wall_s, "exit_status": status}
    if (scratch / "timing.json").is_file():
        row |= json.loads((scratch / "timing.json").read_text(encoding="utf-8"))
    return row


def evaluate(result: Path, reference: Path) -> dict[str, Any] | None:
    """Return the figures of `onthefly3r evaluate`, None when it failed."""
    command = [
        sys.executable,
        "-m",
        "onthefly3r",
        "evaluate",
        str(result),
        "--reference-poses",
        str(reference),
        "--json",
    ]
    ran = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    for line in ran.stdout.splitlines():
        event = json.loads(line)
        if event["kind"] == "result":
            return dict(event)
    print(ran.stderr.strip(), file=sys.stderr)
    return None


def measure(folder: Path, work: Path, threads: int, options: list[str], with_peer: bool) -> dict[str, Any]:
    """Run both programs on one set and return its figures."""
    work.mkdir(parents=True)
    photos = photos_of(folder)
    count = count_photographs(photos)
    row: dict[str, Any] = {"set": folder.name, "photographs": count, "ours": run_ours(photos, work, options)}
    row["ours"]["s_per_image"] = row["ours"]["wall_s"] / count
    if with_peer:
        row["peer"] = run_peer(photos, work, threads)
        row["peer"]["s_per_image"] = row["peer"]["wall_s"] / count
        if row["ours"]["exit_status"] == row["peer"]["exit_status"] == 0:
            row["times_faster"] = row["peer"]["wall_s"] / row["ours"]["wall_s"]
    if (folder / "reference").is_dir() and row["ours"]["exit_status"] == 0:
        row["evaluation"] = evaluate(work / "ours", folder / "reference")
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Return the figures as a table in Markdown."""
    head = "| set | photographs | ours s/image | pycolmap s/image | times faster | coverage | ATE % | ARE deg | MiB |"
    lines = [head, "|---|---|---|---|---|---|---|---|---|"]
    for row in rows:
        figures = (row.get("evaluation") or {}).get("poses") or {}
        cells = [
            row["set"],
            str(row["photographs"]),
            shown(row["ours"]["s_per_image"]) + ("" if row["ours"]["exit_status"] == 0 else " (failed)"),
            shown(row.get("peer", {}).get("s_per_image")),
            shown(row.get("times_faster")),
            shown(figures.get("coverage"), 3),
            shown(figures.get("ate_percent_of_depth"), 3),
            shown(figures.get("are_deg"), 3),
            shown(row["ours"].get("memory_mib"), 0),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def shown(value: float | None, digits: int = 2) -> str:
    """Return a figure for the table, a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> int:
    """Measure every set named on the command line, print the table, write the JSON; 1 when a run of ours failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "sets", nargs="+", type=Path, help="folders with photos/ and perhaps reference/, or photographs"
    )
    parser.add_argument("--work", type=Path, default=Path("benchmark-work"), help="scratch folder; it is emptied")
    parser.add_argument("--json", type=Path, help="file for the figures (default: WORK/figures.json)")
    parser.add_argument("--no-peer", action="store_true", help="only our run")
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[], help="what follows goes to `onthefly3r run`")
    chosen = parser.parse_args()
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if chosen.work.exists() and not (chosen.work / "figures.json").exists() and any(chosen.work.iterdir()):
        parser.error(f"{chosen.work} holds something else: name another folder for --work")
    shutil.rmtree(chosen.work, ignore_errors=True)
    rows = []
    for folder in chosen.sets:
        rows.append(measure(folder, chosen.work / folder.name, threads, chosen.options, not chosen.no_peer))
        print(table(rows[-1:]), flush=True)
    figures = {"machine": platform.platform(), "cores": threads, "options": chosen.options, "sets": rows}
    (chosen.json or chosen.work / "figures.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    print("\n" + table(rows))
    return int(any(row["ours"]["exit_status"] != 0 for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
