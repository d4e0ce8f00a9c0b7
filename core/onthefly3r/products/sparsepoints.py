"""A few points of every photograph, for the COLMAP model."""

from __future__ import annotations

import numpy as np

from ..map.state import MapState
from .colmap import SparsePoints
from .exportframe import ExportFrame

SPARSE_POINTS_PER_IMAGE = 200


def sparse_points(state: MapState, frame: ExportFrame) -> SparsePoints:
    """Some compact reference points of every frame, each seen by the image that it belongs to."""
    points, images, pixels = [], [], []
    for index, stored in sorted(state.frames.items()):
        reference = state.reference(index)
        best = np.argsort(-reference.confidence, kind="stable")[:SPARSE_POINTS_PER_IMAGE]
        mapped = state.submap_pose_of(index).apply(reference.points[best].astype(float))
        points.append(frame.points(mapped))
        images.append(np.full(len(best), index))
        pixels.append(stored.grid_from_photo.inverse().apply(reference.pixels[best] + 0.5))
    joined = np.vstack(points)
    return SparsePoints(
        points=joined,
        rgb=np.full((len(joined), 3), 128, np.uint8),
        error_px=np.zeros(len(joined)),
        point=np.arange(len(joined)),
        image=np.concatenate(images),
        pixels=np.vstack(pixels),
    )
