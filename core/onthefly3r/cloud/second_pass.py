"""The second dense pass: depth maps with the final cameras, laid on each other, averaged, and told with confidence.

Each stage reads what the one before wrote for all photographs, and keeps only a bounded part of it in memory:
pictures, stereo with the best partners among all placed photographs, one smooth factor of depth and one gain of
colour per photograph, and two passes of averages along the ray. What comes out are points by photograph, for the
fusion that thins them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import PhotographError
from ..geometry.arrays import Bool, Float
from ..records import CloudTile
from .alignment import Comparison, align, compare, factors
from .averaging import Averaged, average
from .colour import gains, harmonised, smoothed
from .depth import PARTNERS, pictures, stereo_depth
from .figures import Checkpoint, DenseFigures
from .layers import LayerCollector
from .maps import MapFolder
from .partners import Overlaps
from .views import View

NEIGHBOURS = 10  # whose depth maps are compared and averaged with a photograph's own
MOST_SENIORS = 0  # a point is left to neighbours that see it closer to their middle, when more of them agree,
STEEP = 0.6  # but not where depth changes by more than this part of a pixel's width per pixel: walls, crowns, edges
ALONE = 0.4  # confidence of a point that no other photograph's depth map confirms,
DOUBT = 0.5  # and the factor of doubt for each that does: certain is what three photographs agree on

Result = TypeVar("Result")


def second_pass(
    views: Mapping[int, View], work: Path, checkpoint: Checkpoint, threads: int, figures: DenseFigures
) -> Iterator[CloudTile]:
    """Yield the points of each photograph in the level frame, in the order of the views.

    Args:
        views: all placed photographs.
        work: folder for temporary files (about 20 bytes a pixel), removed from it at the end.
        checkpoint: called for every photograph of every stage.
        threads: of the processor; the result does not depend on them.
        figures: takes what the report tells.
    """
    overlaps = Overlaps(views)
    with MapFolder(work) as maps, ThreadPoolExecutor(threads) as pool:

        def each(stage: str, function: Callable[[int], Result], indices: Sequence[int]) -> Iterator[Result]:
            checkpoint(stage, 0, len(indices))
            waiting = [pool.submit(function, index) for index in indices[: 2 * threads]]
            try:
                for done in range(len(indices)):
                    following = done + 2 * threads
                    if following < len(indices):
                        waiting.append(pool.submit(function, indices[following]))
                    result = waiting.pop(0).result()
                    checkpoint(stage, done + 1, len(indices))
                    yield result
            finally:
                for future in waiting:
                    future.cancel()

        loaded = dict(
            zip(views, each("reading photographs again", partial(_load, views, maps), list(views)), strict=True)
        )
        seen = [index for index in views if loaded[index]]
        figures.unreadable = [views[index].shot.name for index in views if not loaded[index]]
        near = {i: [j for j in overlaps.partners(i, NEIGHBOURS + 2) if loaded[j]][:NEIGHBOURS] for i in seen}
        partners = {i: [j for j in overlaps.partners(i, PARTNERS + 2) if loaded[j]][:PARTNERS] for i in seen}
        found = list(each("matching depths", partial(_stereo, views, maps, partners), seen))
        figures.photographs = sum(found)
        compared = each("comparing depths", partial(_compare, views, maps, near), seen)
        comparisons = [item for items in compared for item in items]
        aligned = align(seen, comparisons)
        figures.before_alignment, figures.after_alignment = aligned.before, aligned.after
        gain = gains(seen, comparisons)
        single, averaged = (LayerCollector.over(views, figures.metric) for _ in range(2))

        def aligned_depth(index: int) -> None:
            depth = maps.read("stereo", index)
            maps.write("depth", index, depth * factors(aligned.terms[index], depth.shape[1], depth.shape[0]))

        for _ in each("aligning depths", aligned_depth, seen):
            pass
        maps.forget("stereo")
        for index, points in zip(
            seen, each("averaging depths", partial(_first_average, views, maps, near), seen), strict=True
        ):
            single.add(index, points)
        maps.forget("depth")
        results = each("making points", partial(_points, views, maps, near, gain), seen)
        for index, (tile, points) in zip(seen, results, strict=True):
            averaged.add(index, points)
            if len(tile.points):
                yield tile
        figures.single, figures.averaged = single.spread(), averaged.spread()


def _load(views: Mapping[int, View], maps: MapFolder, index: int) -> bool:
    try:
        grey, rgb = pictures(views[index])
    except (OSError, PhotographError):
        return False
    maps.write("grey", index, grey)
    maps.write("rgb", index, rgb)
    return True


def _stereo(views: Mapping[int, View], maps: MapFolder, partners: Mapping[int, Sequence[int]], index: int) -> bool:
    row_of = {id(views[i]): i for i in (index, *partners[index])}
    depth, _ = stereo_depth(
        views[index], [views[j] for j in partners[index]], lambda view: maps.read("grey", row_of[id(view)])
    )
    maps.write("stereo", index, depth)
    return bool(depth.any())


def _compare(
    views: Mapping[int, View], maps: MapFolder, near: Mapping[int, Sequence[int]], index: int
) -> list[Comparison]:
    own = maps.read("stereo", index), smoothed(maps.read("rgb", index))
    found = []
    for other in near[index]:
        theirs = maps.read("stereo", other), smoothed(maps.read("rgb", other))
        comparison = compare(index, other, views, (own[0], theirs[0]), (own[1], theirs[1]))
        if comparison is not None:
            found.append(comparison)
    return found


def _averaged(
    kind: str, views: Mapping[int, View], maps: MapFolder, near: Mapping[int, Sequence[int]], index: int
) -> Averaged:
    return average(views[index], maps.read(kind, index), [(views[j], maps.read(kind, j)) for j in near[index]])


def _first_average(views: Mapping[int, View], maps: MapFolder, near: Mapping[int, Sequence[int]], index: int) -> Float:
    """Write the first averages and return the points of the map as it was, where others agree."""
    found = _averaged("depth", views, maps, near, index)
    maps.write("average", index, found.depth)
    return _lifted(views[index], maps.read("depth", index), (found.support > 0) & (found.against <= found.support))


def _points(
    views: Mapping[int, View],
    maps: MapFolder,
    near: Mapping[int, Sequence[int]],
    gain: Mapping[int, Float],
    index: int,
) -> tuple[CloudTile, Float]:
    """Return the photograph's share of the cloud, and all the points that it sees with others."""
    view = views[index]
    found = _averaged("average", views, maps, near, index)
    sound = (found.depth > 0.0) & (found.against <= found.support)
    steep = _is_steep(view, found.depth)
    sound &= ~steep | (found.against == 0) | (found.support >= 2)  # where a mismatch is most likely, no doubt is left
    kept = sound & ((found.seniors <= MOST_SENIORS) | steep)
    support = found.support[kept].astype(np.float32)
    against = found.against[kept].astype(np.float32)
    confidence = (1.0 - (1.0 - ALONE) * DOUBT**support) * (1.0 - against / (1.0 + support + against))
    count = len(confidence)
    tile = CloudTile(
        points=_lifted(view, found.depth, kept),
        rgb=harmonised(maps.read("rgb", index)[kept], gain[index]),
        confidence=confidence.astype(np.float32),
        source=np.full(count, index, np.int32),
        batch=np.full(count, view.batch, np.int32),
        views=(1 + found.support[kept]).astype(np.int32),
    )
    return tile, _lifted(view, found.depth, sound & (found.support > 0))


def _is_steep(view: View, depth: Float) -> Bool:
    """Return where (H, W) the photograph sees its surface at a slant, or next to nothing known."""
    import cv2

    block = np.ones((3, 3), np.uint8)
    change = cv2.dilate(depth, block) - cv2.erode(depth, block)  # over two pixels
    return np.asarray(change * np.float32(0.5 * view.grid.fx) > np.float32(STEEP) * depth)


def _lifted(view: View, depth: Float, chosen: Bool) -> Float:
    """Return the points (N, 3) of chosen pixels in the level frame."""
    rows, columns = np.nonzero(chosen)
    z = depth[rows, columns].astype(float)
    x = (columns + 0.5 - view.grid.cx) / view.grid.fx * z
    y = (rows + 0.5 - view.grid.cy) / view.grid.fy * z
    return view.level_from_cam.apply(np.stack([x, y, z], axis=-1))
