"""How far the sheets of single photographs lie apart in a cloud: internal consistency, from the file and the report.

    python benchmarks/layers.py RUN_OR_CLOUD [...]

For each LAS or LAZ file, or each output folder of a run: over cells of 1 m, the range of the photographs' median
heights with the slope of the cell taken out, median and 90th percentile. A cloud that is thinned to one point per voxel
has few photographs in a cell; what the run measured on all its depth maps, alone and averaged, is in its report.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import laspy
import numpy as np

from onthefly3r.cloud.layers import LayerCollector, LayerSpread


def of_file(path: Path) -> LayerSpread:
    """Return the spread of a cloud whose point source ids are photographs; whole in memory."""
    cloud = laspy.read(path)
    points = np.column_stack([cloud.x, cloud.y, cloud.z])
    sources = np.asarray(cloud["image"] if "image" in cloud.point_format.dimension_names else cloud.point_source_id)
    low, high = np.percentile(points[:, :2], [1, 99], axis=0)
    collector = LayerCollector(1.0, float(np.prod(high - low)))
    for source in np.unique(sources):
        collector.add(int(source), points[sources == source] - points[0])
    return collector.spread()


def told(spread: LayerSpread) -> str:
    """Return one line."""
    return f"median {spread.median:.4f} m, p90 {spread.p90:.4f} m of {spread.cells} cells"


def main() -> None:
    """Print the figures of every argument."""
    for given in map(Path, sys.argv[1:]):
        files = [path for name in ("cloud.laz", "cloud.las") if (path := given / name).exists()]
        for path in files if given.is_dir() else [given]:
            print(f"{path}: {told(of_file(path))}")
        report = given / "report.json"
        if given.is_dir() and report.exists():
            dense = json.loads(report.read_text(encoding="utf-8"))["details"].get("dense_cloud", {})
            for name, layers in dense.get("layers", {}).items():
                print(f"{report}, {dense['quality']}, {name} maps: {told(LayerSpread(**layers))}")


if __name__ == "__main__":
    main()
