"""The cloud of the first pass, its depths corrected: what the map was built with, for the price of reading it twice.

The local models' point maps keep the shape of early intrinsics and of a few photographs. Their rays are drawn again
through the final lens, one smooth factor of depth per photograph is fitted against the adjustment's tracks and the
maps of overlapping photographs, and each depth is averaged once with those of the photographs that agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ..geometry.arrays import Float, UInt8
from ..geometry.transforms import Sim3
from ..map.state import MapState
from ..map.store import Store, StoredPoints
from ..records import CloudTile
from .alignment import align, basis, compare, factors
from .averaging import average
from .colour import gains, harmonised
from .depthties import track_ties
from .figures import Checkpoint, DenseFigures
from .layers import LayerCollector
from .maps import MapFolder
from .partners import Overlaps
from .views import View

NEIGHBOURS = 8
STEP_PX = 6  # between the pixels that are compared


def first_pass(
    state: MapState,
    store: Store,
    views: Mapping[int, View],
    level_from_map: Sim3,
    work: Path,
    checkpoint: Checkpoint,
    figures: DenseFigures,
) -> Iterator[CloudTile]:
    """Yield the corrected points of each photograph in the level frame; without final cameras they stay as they are.

    views: of the size of the point maps, with the poses under which the points lie.
    """
    redrawn = _Redrawing(state, views, level_from_map)
    overlaps = Overlaps(views)
    near = {index: overlaps.partners(index, NEIGHBOURS) for index in views}
    alone, together = (LayerCollector.over(views, figures.metric) for _ in range(2))
    with MapFolder(work) as maps:
        for done, stored in enumerate(store.stream_points(), start=1):
            checkpoint("collecting points", done, 2 * len(views))
            if stored.index in views:
                depth, rgb = redrawn.gridded(stored)
                maps.write("depth", stored.index, depth)
                maps.write("rgb", stored.index, rgb)
        comparisons = []
        for done, index in enumerate(views, start=1):
            checkpoint("comparing depths", done, len(views))
            for other in near[index]:
                depths = maps.read("depth", index), maps.read("depth", other)
                colours = maps.read("rgb", index), maps.read("rgb", other)
                found = compare(index, other, views, depths, colours, STEP_PX)
                if found is not None:
                    comparisons.append(found)
        ties = track_ties(state, store, views, lambda index: maps.read("depth", index))
        aligned, gain = align(list(views), comparisons, ties), gains(list(views), comparisons)
        figures.before_alignment, figures.after_alignment = aligned.before, aligned.after
        for index, view in views.items():
            depth = maps.read("depth", index) * factors(aligned.terms[index], view.grid.width, view.grid.height)
            maps.write("aligned", index, depth)
        for done, stored in enumerate(store.stream_points(), start=len(views) + 1):
            checkpoint("collecting points", done, 2 * len(views))
            count = len(stored.points)
            if count == 0 or stored.index not in views:
                continue
            depth = maps.read("aligned", stored.index)
            others = [(views[other], maps.read("aligned", other)) for other in near[stored.index]]
            mean = average(views[stored.index], depth, others).depth
            single, points = redrawn.points(stored, aligned.terms[stored.index], mean / np.where(depth > 0, depth, 1))
            alone.add(stored.index, single)
            together.add(stored.index, points)
            figures.photographs += 1
            yield CloudTile(
                points=points,
                rgb=harmonised(stored.rgb, gain[stored.index]),
                confidence=stored.confidence.astype(np.float32) / np.float32(255.0),
                source=np.full(count, stored.index, np.int32),
                batch=np.full(count, stored.submap, np.int32),
                views=np.ones(count, np.int32),
            )
    figures.single, figures.averaged = alone.spread(), together.spread()


class _Redrawing:
    """Takes stored points to their pixel and depth, and back out along the rays of the final camera."""

    def __init__(self, state: MapState, views: Mapping[int, View], level_from_map: Sim3) -> None:
        self._state, self._views, self._level_from_map = state, views, level_from_map
        self._turns: dict[tuple[object, object], Float] = {}

    def gridded(self, stored: StoredPoints) -> tuple[Float, UInt8]:
        """Return the depths (H, W) float32 and colours (H, W, 3) in the view's grid, 0 where there is no point."""
        slopes, depth, _ = self._seen(stored)
        grid = self._views[stored.index].grid
        columns, rows = np.floor(slopes * grid.fx + (grid.cx, grid.cy)).astype(int).T
        inside = (columns >= 0) & (columns < grid.width) & (rows >= 0) & (rows < grid.height)
        depths = np.zeros((grid.height, grid.width), np.float32)
        rgb = np.zeros((grid.height, grid.width, 3), np.uint8)
        depths[rows[inside], columns[inside]] = depth[inside]
        rgb[rows[inside], columns[inside]] = stored.rgb[inside]
        return depths, rgb

    def points(self, stored: StoredPoints, terms: Float, ratio: Float) -> tuple[Float, Float]:
        """Return the points (N, 3) in the level frame with the factor of `terms` (6,), and with that of the mean too.

        ratio: (H, W) of the mean depth over that of the photograph alone.
        """
        view = self._views[stored.index]
        slopes, depth, place = self._seen(stored)
        columns, rows = np.minimum(
            (0.5 * (place + 1.0) * (view.grid.width, view.grid.height)).astype(int),
            (view.grid.width - 1, view.grid.height - 1),
        ).T
        depth = depth * np.exp(basis(place) @ terms)
        mean = depth * np.where(ratio[rows, columns] > 0.0, ratio[rows, columns], 1.0)
        alone, together = (np.column_stack([slopes * d[:, None], d]) for d in (depth, mean))
        return view.level_from_cam.apply(alone), view.level_from_cam.apply(together)

    def _seen(self, stored: StoredPoints) -> tuple[Float, Float, Float]:
        """Return slopes (N, 2) of the final rays, depths (N,), and places (N, 2) in the grid, -1..1."""
        frame, view = self._state.frames[stored.index], self._views[stored.index]
        in_camera = frame.submap_from_cam.inverse().apply(stored.points.astype(float))
        depth = in_camera[:, 2]
        pixels = frame.camera.project(in_camera)
        size = np.array([frame.camera.width, frame.camera.height])
        columns, rows = np.clip(np.nan_to_num(pixels), 0, size - 1).astype(int).T
        slopes = in_camera[:, :2] / depth[:, None] + self._turn(stored.index)[rows, columns]
        scale = (self._level_from_map @ self._state.submap_pose_of(stored.index)).scale
        grid = view.grid
        place = 2.0 * (slopes * grid.fx + (grid.cx, grid.cy)) / (grid.width, grid.height) - 1.0
        return slopes, depth * scale, np.clip(place, -1.0, 1.0)

    def _turn(self, index: int) -> Float:
        """Return by how much (H, W, 2) the final camera's rays differ from those that the points were drawn with."""
        early, final = self._state.frames[index].camera, self._views[index].camera
        if (early, final) not in self._turns:
            centres = early.pixel_centres()
            self._turns[early, final] = (final.rays(centres) - early.rays(centres))[..., :2].astype(np.float32)
        return self._turns[early, final]
