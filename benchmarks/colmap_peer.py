"""Time a whole run of ours against whole runs of pycolmap on the same photographs, one after the other.

Ours counts everything from the start of the process to its end: dense point maps, georeferencing, files; with
`--options --no-cloud` it counts the cameras. pycolmap counts its reconstruction of the cameras alone, as two people
would run it: the default one (SIFT with 6,000 features at 1600 px, exhaustive matching, incremental mapping), and the
expert's (2,500 features at 1000 px, spatial matching with 20 neighbours, global mapping). Times are CPU seconds of the
whole process, user and system, beside wall time. See README.md beside this file.
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}

# Runs in a process of its own: its times and peak memory are then pycolmap's alone.
PEER = """
import json, sys, time, zlib
import pycolmap
photos, work, threads, expert = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4] == "expert"
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
extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, threads, 1000 if expert else 1600
extraction.sift.max_num_features = 2500 if expert else 6000
pycolmap.extract_features(
    database, photos, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, extraction_options=extraction
)
lap("extraction_s")
matching = pycolmap.FeatureMatchingOptions()
matching.use_gpu, matching.num_threads = False, threads
if expert:
    pairing = pycolmap.SpatialPairingOptions()
    pairing.max_num_neighbors, pairing.num_threads = 20, threads
    pycolmap.match_spatial(database, matching_options=matching, pairing_options=pairing)
else:
    pycolmap.match_exhaustive(database, matching_options=matching)
lap("matching_s")
mapping = pycolmap.GlobalPipelineOptions() if expert else pycolmap.IncrementalPipelineOptions()
mapping.num_threads = threads
mapped = pycolmap.global_mapping if expert else pycolmap.incremental_mapping
models = mapped(database, photos, work, options=mapping)
lap("mapping_s")
largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
if largest is not None:
    largest.write_text(work)
with open(work + "/timing.json", "w") as stream:
    json.dump({"seconds": seconds, "placed": 0 if largest is None else largest.num_reg_images()}, stream)
"""
PEERS = ("expert", "default")


def photos_of(folder: Path) -> Path:
    """Return the folder that holds the photographs: a data folder's photos/, or the folder itself."""
    return folder / "photos" if (folder / "photos").is_dir() else folder


def count_photographs(photos: Path) -> int:
    """Return how many photographs a folder holds, sub-folders included."""
    return sum(path.suffix.lower() in SUFFIXES for path in photos.rglob("*"))


def timed(command: list[str], log: Path) -> dict[str, Any]:
    """Run a command with its output in `log`; return wall and CPU seconds and the exit status.

    CPU seconds are None on Windows, which does not tell those of a process that has ended.
    """
    began = time.perf_counter()
    with (
        log.open("w", encoding="utf-8") as stream,
        subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT) as process,
    ):
        cpu_s = None
        if sys.platform != "win32":
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            cpu_s = usage.ru_utime + usage.ru_stime
        process.wait()
    return {"wall_s": time.perf_counter() - began, "cpu_s": cpu_s, "exit_status": process.returncode}


def run_ours(photos: Path, work: Path, options: list[str]) -> dict[str, Any]:
    """Run the command line on the photographs."""
    out = work / "ours"
    command = [sys.executable, "-m", "onthefly3r", "run", str(photos), str(out), "--json", *options]
    row = timed(command, work / "ours.log")
    if (out / "report.json").is_file():
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
        row["placed"] = report["images"]["placed"]
        row["memory_mib"] = report.get("memory", {}).get("peak_rss_mib")
        row["timing"] = report["timing"]
    return row


def run_peer(photos: Path, work: Path, threads: int, peer: str) -> dict[str, Any]:
    """Run pycolmap on the same photographs, the way that `peer` names; the model it made is in WORK/PEER."""
    scratch = work / peer
    scratch.mkdir()
    command = [sys.executable, "-c", PEER, str(photos), str(scratch), str(threads), peer]
    row = timed(command, work / f"{peer}.log")
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


def measure(folder: Path, work: Path, threads: int, options: list[str], peers: Sequence[str]) -> dict[str, Any]:
    """Run ours and the peers on one set and return the figures, the time of each peer over ours among them."""
    work.mkdir(parents=True)
    photos = photos_of(folder)
    count = count_photographs(photos)
    row: dict[str, Any] = {"set": folder.name, "photographs": count, "ours": run_ours(photos, work, options)}
    row["peers"] = {peer: run_peer(photos, work, threads, peer) for peer in peers}
    reference = folder / "reference"
    for ran in (row["ours"], *row["peers"].values()):
        ran["s_per_image"] = (ran["cpu_s"] or ran["wall_s"]) / count
        ran["of_ours"] = ran["s_per_image"] / row["ours"]["s_per_image"]
    if reference.is_dir():
        for name, ran in (("ours", row["ours"]), *row["peers"].items()):
            if ran["exit_status"] == 0:
                ran["evaluation"] = evaluate(work / name, reference)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Return the figures as a table in Markdown."""
    head = "| set | program | CPU s/image | wall s/image | times ours | placed | coverage | ATE % | ARE deg | MiB |"
    lines = [head, "|---|---|---|---|---|---|---|---|---|---|"]
    for row in rows:
        for name, ran in (("ours", row["ours"]), *((f"COLMAP, {n}", peer) for n, peer in row["peers"].items())):
            figures = (ran.get("evaluation") or {}).get("poses") or {}
            cpu_s = None if ran["cpu_s"] is None else ran["cpu_s"] / row["photographs"]
            cells = [
                row["set"],
                name + ("" if ran["exit_status"] == 0 else " (failed)"),
                shown(cpu_s, 3),
                shown(ran["wall_s"] / row["photographs"], 3),
                shown(ran["of_ours"]),
                f"{ran.get('placed', 0)} of {row['photographs']}",
                shown(figures.get("coverage"), 3),
                shown(figures.get("ate_percent_of_depth"), 3),
                shown(figures.get("are_deg"), 3),
                shown(ran.get("memory_mib"), 0),
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
    parser.add_argument(
        "--peers", nargs="*", choices=PEERS, default=["expert"], help="ways to run pycolmap (default: expert)"
    )
    parser.add_argument("--options", nargs=argparse.REMAINDER, default=[], help="what follows goes to `onthefly3r run`")
    chosen = parser.parse_args()
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if chosen.work.exists() and not (chosen.work / "figures.json").exists() and any(chosen.work.iterdir()):
        parser.error(f"{chosen.work} holds something else: name another folder for --work")
    shutil.rmtree(chosen.work, ignore_errors=True)
    rows = []
    for folder in chosen.sets:
        rows.append(measure(folder, chosen.work / folder.name, threads, chosen.options, chosen.peers))
        print(table(rows[-1:]), flush=True)
    figures = {"machine": platform.platform(), "cores": threads, "options": chosen.options, "sets": rows}
    (chosen.json or chosen.work / "figures.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    print("\n" + table(rows))
    return int(any(row["ours"]["exit_status"] != 0 for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
