"""The camera poses as a table."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from ..files.atomic import replacing
from .rows import CameraRow

COLUMNS = ("image", "x", "y", "z", "omega", "phi", "kappa", "status")


def write_trajectory(path: Path, rows: Iterable[CameraRow]) -> None:
    """Write `trajectory.csv` (UTF-8, comma, header): export frame in m, grid angles in degrees; blank where unplaced.

    Rows stay in the order given, which must be capture order: `evaluate` takes consecutive rows as consecutive shots.
    """
    with (
        replacing(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="surrogateescape", newline="") as stream,
    ):
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            numbers = (row.x, row.y, row.z, row.omega, row.phi, row.kappa)
            writer.writerow([row.image, *("" if n is None else f"{n:.6f}" for n in numbers), row.status])
