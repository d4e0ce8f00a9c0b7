"""Kill a run at random moments, go on with it, and compare the result with that of an uninterrupted run.

    python benchmarks/kills.py FOLDER [--kills 50] [--images 60] [--threads 2]

A rendered survey and its results are made below FOLDER. The whole process group gets SIGKILL at a random moment of
the time that an uninterrupted run takes, as often as asked, a run that was killed going on until it ends.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from onthefly3r.map.state import MapState
from onthefly3r.map.store import Store
from onthefly3r.simulate import SurveyOptions, simulate_survey


def main() -> None:
    """Print a table of kills and of the runs that ended after them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--width-px", type=int, default=600)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    photos = asked.folder / "photos"
    size = {"image_width_px": asked.width_px, "image_height_px": asked.width_px * 3 // 4}
    if not photos.is_dir():
        simulate_survey(asked.folder, SurveyOptions(images=asked.images, seed=2, **size))
    options = ["--threads", str(asked.threads), "--dense-px", "120", "--no-rasters", "--orthophoto", "none"]
    whole, out = asked.folder / "whole", asked.folder / "killed"
    command = [sys.executable, "-m", "onthefly3r", "run", str(photos)]
    began = time.monotonic()
    subprocess.run([*command, str(whole), *options], check=True, capture_output=True)
    lasts_s = time.monotonic() - began
    print(f"{asked.images} photographs, uninterrupted {lasts_s:.0f} s")
    print("kill   after s   journal bytes")
    draw, kills, runs = random.Random(asked.seed), 0, []
    while kills < asked.kills:
        process = subprocess.Popen(
            [*command, str(out), *options], start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        after_s = draw.uniform(0.0, 0.5 * lasts_s)
        try:
            _, errors = process.communicate(timeout=after_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            kills += 1
            journals = sorted(out.glob("work/**/journal.jsonl")) if out.is_dir() else []
            print(f"{kills:4d}   {after_s:7.1f}   {[path.stat().st_size for path in journals]}", flush=True)
            continue
        if process.returncode != 0:
            sys.exit(f"the run ended with {process.returncode}: {errors.decode()}")
        runs.append(compare(out, whole))
        shutil.rmtree(out)
    subprocess.run([*command, str(out), *options], check=True, capture_output=True)
    runs.append(compare(out, whole))
    print("run   placed alike   journal alike   farthest camera, of the flying height")
    for number, (placed, journal, farthest) in enumerate(runs, start=1):
        print(f"{number:3d}   {placed!s:12}   {journal!s:13}   {farthest:.1e}")


def compare(out: Path, whole: Path) -> tuple[bool, bool, float]:
    """Return whether two runs placed the same photographs and wrote the same journal, and how far cameras differ."""
    one, other = (MapState.load(Store(folder / "work")) for folder in (out, whole))
    same = (out / "work" / "journal.jsonl").read_bytes() == (whole / "work" / "journal.jsonl").read_bytes()
    height = float(np.median([frame.depth for frame in other.frames.values()]))
    offsets = [
        float(np.linalg.norm(one.map_from_cam(i).translation - other.map_from_cam(i).translation)) / height
        for i in other.frames.keys() & one.frames.keys()
    ]
    return list(one.frames) == list(other.frames), same, max(offsets, default=float("nan"))


if __name__ == "__main__":
    main()
