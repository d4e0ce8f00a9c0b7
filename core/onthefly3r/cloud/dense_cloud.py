"""The points of a run before they are fused: corrected ones of the first pass, or those of a second pass."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ..geometry.transforms import Sim3
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..records import CloudTile, Shot
from .figures import Checkpoint, DenseFigures
from .first_pass import first_pass
from .second_pass import second_pass
from .views import placed_views, point_views

SIZE_PX = {"standard": 800, "full": 1600}  # longest side of the photographs in the second pass


def dense_points(
    state: MapState,
    store: Store,
    shots: Mapping[int, Shot],
    level_from_map: Sim3,
    options: Options,
    work: Path,
    checkpoint: Checkpoint,
    figures: DenseFigures,
) -> Iterator[CloudTile]:
    """Yield the points of every placed photograph in the level frame, photograph by photograph.

    Photographs that cannot be opened any more give the points of the first pass instead; `figures` names them.

    Args:
        state: the map.
        store: where its points are.
        shots: at least those of the map.
        level_from_map: to metres, up along the third axis, or to the levelled map.
        options: `quality` and `threads` count.
        work: folder for temporary files.
        checkpoint: called for every photograph of every stage.
        figures: takes what the report tells.
    """
    early = point_views(state, shots, level_from_map)
    if figures.quality in SIZE_PX:
        views = placed_views(state, shots, level_from_map, SIZE_PX[figures.quality])
        threads = options.backbone.threads or os.cpu_count() or 1
        yield from second_pass(views, work / "depth", checkpoint, threads, figures)
        unreadable = set(figures.unreadable)
        early = {index: view for index, view in early.items() if view.shot.name in unreadable}
        figures = DenseFigures("preview", figures.metric)  # theirs are not told
    if early:
        yield from first_pass(state, store, early, level_from_map, work / "depth", checkpoint, figures)


def point_spacing_m(state: MapState, shots: Mapping[int, Shot], level_from_map: Sim3, quality: str) -> float:
    """Return the ground sampling distance of the depth maps, the distance at which points of the cloud lie."""
    first = level_from_map.scale * state.spacing
    if quality not in SIZE_PX or not state.frames:
        return first
    finer = [
        max(frame.camera.width, frame.camera.height)
        / min(SIZE_PX[quality], max(shots[index].width_px, shots[index].height_px))
        for index, frame in state.frames.items()
    ]
    return first * float(np.median(finer))
