"""Precision of retrieval descriptors on real surveys against the neighbours in a reference reconstruction.

Local features alone, a network alone, and both side by side with several shares. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from onthefly3r.evaluate.readers import read_poses, scene_depth
from onthefly3r.features.extraction import FeatureStore
from onthefly3r.geometry.arrays import Bool, Float
from onthefly3r.intake.folder import read_photographs
from onthefly3r.intake.images import load_working_image
from onthefly3r.options import BackboneOptions, IntakeOptions, SelectionOptions
from onthefly3r.records import WorkingImage
from onthefly3r.selection.descriptors import VladDescriber
from onthefly3r.selection.neural import EfficientNetDescriber

ANSWERS, NEIGHBOURS = 5, 10  # precision of the five best answers against the ten nearest photographs
BESIDE = 5  # photographs before and after in capture order that a stricter figure leaves out
SHARES = (0.3, 0.5, 0.7)  # weight of the network beside local features


def descriptors(photos: Path) -> tuple[list[str], dict[str, Float], dict[str, float]]:
    """Return names, one row per photograph for each descriptor, and the seconds that a photograph took."""
    shots, _ = read_photographs(photos, IntakeOptions())
    backbone = BackboneOptions()
    rows: dict[str, list[Float]] = {}
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        store = FeatureStore(Path(folder), backbone.features)
        vlad, network = VladDescriber(store), EfficientNetDescriber()

        def timed(name: str, index: int, image: WorkingImage) -> None:
            began = time.perf_counter()
            rows.setdefault(name, []).append((vlad if name == "vlad" else network).describe(index, image))
            seconds[name] = seconds.get(name, 0.0) + (time.perf_counter() - began) / len(shots)

        first = shots[: SelectionOptions().seed_size]
        vlad.fit({i: load_working_image(shot, backbone.working_px) for i, shot in enumerate(first)})
        for index, shot in enumerate(shots):
            image = load_working_image(shot, backbone.working_px)
            store.features_of(index, image)  # the backbone needs it too: not the descriptor's time
            timed("vlad", index, image)
            timed("efficientnet", index, image)
    return [shot.name for shot in shots], {name: np.array(kept) for name, kept in rows.items()}, seconds


def precision(similarity: Float, near: Bool, allowed: Bool) -> float:
    """Return the share of the best answers that are near, over photographs with enough allowed answers."""
    shares = []
    for row, good, open_ in zip(similarity, near, allowed, strict=True):
        if open_.sum() >= 2 * ANSWERS:
            best = np.flatnonzero(open_)[np.argsort(-row[open_])[:ANSWERS]]
            shares.append(good[best].mean())
    return float(np.mean(shares))


def nearest(places: Float, allowed: Bool) -> Bool:
    """Mark the nearest allowed photographs of each one, (N, N), by the distance of their places (N, 3)."""
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    distance[~allowed] = np.inf
    near = np.zeros_like(allowed)
    for row, kept in enumerate(np.argsort(distance, axis=1)[:, :NEIGHBOURS]):
        near[row, kept] = allowed[row, kept]
    return near


def figures(vectors: Float, places: Float) -> list[float]:
    """Return the precision among all, without neighbours in capture order, and among earlier photographs only."""
    similarity = vectors @ vectors.T
    order = np.arange(len(vectors))
    apart = np.abs(order[:, None] - order)
    return [
        precision(similarity, nearest(places, allowed), allowed)
        for allowed in (apart > 0, apart > BESIDE, order[:, None] > order)
    ]


def measure(folder: Path) -> None:
    """Print the table of one set: photographs in photos/, the reference in reference/."""
    names, vectors, seconds = descriptors(folder / "photos")
    reference, depth = read_poses(folder / "reference"), scene_depth(folder / "reference")
    row = {name: index for index, name in enumerate(reference.names)}
    both = [(index, row[name]) for index, name in enumerate(names) if name in row]
    given, placed = (np.array(column) for column in zip(*both, strict=True))
    centres = reference.centres[placed]
    looked_at = centres + (depth or 0.0) * reference.rotations[placed][:, :, 2]
    centred = vectors["efficientnet"] - vectors["efficientnet"][: SelectionOptions().seed_size].mean(axis=0)
    parts = {
        "RootSIFT-VLAD": vectors["vlad"],
        "EfficientNet-Lite0": vectors["efficientnet"],
        "EfficientNet-Lite0, centred": unit(centred),
    }
    for share in SHARES:
        parts[f"both, {share}"] = unit(np.hstack([vectors["vlad"], share * vectors["efficientnet"]]))
        parts[f"both, centred, {share}"] = unit(np.hstack([vectors["vlad"], share * unit(centred)]))
    print(f"\n{folder.name}, {len(given)} photographs; seconds each: {seconds}")
    print(f"{'descriptor':30} cameras: all / apart / earlier   places looked at: all / apart / earlier")
    for name, rows in parts.items():
        told = [" / ".join(f"{v:.3f}" for v in figures(rows[given], places)) for places in (centres, looked_at)]
        print(f"{name:30} {told[0]:>32}   {told[1]:>36}")


def unit(vectors: Float) -> Float:
    """Return rows of length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def main() -> int:
    """Measure every set that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", type=Path, help="folder with photos/ and reference/")
    for folder in parser.parse_args().sets:
        measure(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
