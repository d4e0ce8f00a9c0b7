"""Whether two clouds can be compared as they lie: their coordinate systems, height references and extents."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import ReferenceFormatError
from ..geometry.arrays import Float
from ..geometry.geodesy import undulation_m
from .clouds import CloudFile, bounds_of

Move = Callable[[Float], Float]

COARSEST_M = 0.01  # coordinates that are rounded more than this are told


@dataclass(frozen=True)
class _Frame:
    """The parts of a CRS."""

    horizontal: Any  # pyproj.CRS, two axes
    vertical: str  # ellipsoidal, egm96, egm2008, "unknown", or "other"
    vertical_crs: Any  # pyproj.CRS of "other"

    @property
    def name(self) -> str:
        heights = {"unknown": "heights of unknown reference", "other": getattr(self.vertical_crs, "name", "")}
        return f"{self.horizontal.name}, {heights.get(self.vertical, f'{self.vertical} heights')}"


def in_frame_of(result: CloudFile, reference: CloudFile) -> tuple[CloudFile, tuple[str, ...]]:
    """Return the reference cloud in the frame of the result, and what there is to say about that.

    A cloud in another CRS or with another height reference is transformed. Raises `ReferenceFormatError` when PROJ
    cannot do that without guessing, or when the clouds lie apart all the same.
    """
    notes = [note for cloud in (result, reference) if (note := _rounding(cloud))]
    if result.crs is not None and reference.crs is not None:
        reference, more = _transformed(reference, _parts(reference.crs), _parts(result.crs), result)
        notes += more
    elif result.crs is not None or reference.crs is not None:
        without = reference if reference.crs is None else result
        notes.append(f"{without.path} states no CRS: it is taken to be in that of the other cloud")
    _require_overlap(result, reference)
    return reference, tuple(notes)


def _parts(crs: Any) -> _Frame:
    if crs.is_bound:
        crs = crs.source_crs
    if crs.is_compound:
        horizontal, vertical = crs.sub_crs_list[:2]
        return _Frame(horizontal, _vertical_kind(vertical), vertical)
    if len(crs.axis_info) == 3:
        return _Frame(crs.to_2d(), "ellipsoidal", None)
    return _Frame(crs, "unknown", None)


def _vertical_kind(crs: Any) -> str:
    metric = all(abs(axis.unit_conversion_factor - 1.0) < 1e-9 for axis in crs.axis_info)
    text = f"{crs.name} {getattr(crs.datum, 'name', '')}".casefold()
    for sign, kind in (("egm2008", "egm2008"), ("egm96", "egm96"), ("ellipsoid", "ellipsoidal")):
        if metric and sign in text:
            return kind
    return "other"


def _transformed(cloud: CloudFile, source: _Frame, target: _Frame, result: CloudFile) -> tuple[CloudFile, list[str]]:
    same_place = source.horizontal.equals(target.horizontal, ignore_axis_order=True)
    same_height = source.vertical == target.vertical and (
        source.vertical != "other" or source.vertical_crs.equals(target.vertical_crs)
    )
    if same_place and same_height:
        return cloud, []
    open_height = "unknown" in (source.vertical, target.vertical)
    notes = []
    if open_height and not same_height:
        without = cloud if source.vertical == "unknown" else result
        notes.append(f"{without.path} does not state what its heights refer to: heights are compared as they are")
    if same_place and open_height:
        return cloud, notes
    move = _move(source, target, open_height, cloud)
    notes.append(f"{cloud.path} was transformed from {source.name} to {target.name}")
    return _moved(cloud, move), notes


def _move(source: _Frame, target: _Frame, open_height: bool, cloud: CloudFile) -> Move:
    """Return the transformation of points (N, 3)."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    refused = ReferenceFormatError(
        f"{cloud.path}: PROJ cannot transform {source.name} to {target.name} with the grids at hand; transform the "
        "cloud with a program that has them, or compare with --cloud-align poses"
    )
    try:
        if "other" in (source.vertical, target.vertical) and not open_height:
            through = Transformer.from_crs(_whole(source), _whole(target), always_xy=True, allow_ballpark=False)

            def directly(points: Float) -> Float:
                return _finite(np.stack(through.transform(*points.T), axis=-1), refused)

            return directly
        geographic = CRS.from_epsg(4326)
        to_geographic = Transformer.from_crs(source.horizontal, geographic, always_xy=True, allow_ballpark=False)
        from_geographic = Transformer.from_crs(geographic, target.horizontal, always_xy=True, allow_ballpark=False)
    except (CRSError, ProjError):
        raise refused from None

    def by_ellipsoid(points: Float) -> Float:
        lon, lat = to_geographic.transform(points[:, 0], points[:, 1])
        height = points[:, 2]
        if not open_height:
            _finite(np.stack([lon, lat], axis=-1), refused)
            height = height + undulation_m(source.vertical, lat, lon) - undulation_m(target.vertical, lat, lon)
        return _finite(np.stack([*from_geographic.transform(lon, lat), height], axis=-1), refused)

    return by_ellipsoid


def _whole(frame: _Frame) -> Any:
    """Return the CRS of places and heights together."""
    from pyproj.crs import CompoundCRS

    if frame.vertical_crs is None:
        return frame.horizontal.to_3d()
    return CompoundCRS(frame.name, [frame.horizontal, frame.vertical_crs])


def _finite(points: Float, refused: ReferenceFormatError) -> Float:
    if not np.isfinite(points).all():
        raise refused
    return points


def _moved(cloud: CloudFile, move: Move) -> CloudFile:
    def chunks() -> Iterator[Float]:
        return (move(chunk) for chunk in cloud.chunks())

    return replace(cloud, chunks=chunks, bounds=None)


def _require_overlap(result: CloudFile, reference: CloudFile) -> None:
    """Clouds that lie farther apart than they are wide are in different frames, whatever they say."""
    boxes = [bounds_of(cloud) for cloud in (result, reference)]
    gap = np.maximum(boxes[0][0] - boxes[1][1], boxes[1][0] - boxes[0][1]).max()
    widths = [float(np.linalg.norm(box[1] - box[0])) for box in boxes]
    if gap > max(widths):
        spans = (
            f"{cloud.path} spans " + ", ".join(f"{low:.1f} to {high:.1f}" for low, high in box.T)
            for cloud, box in zip((result, reference), boxes, strict=True)
        )
        raise ReferenceFormatError(
            f"the clouds lie {gap:.0f} units apart and cannot be compared: {'; '.join(spans)}. They are in different "
            "coordinate systems; transform one, or align by the cameras (--cloud-align poses)"
        )


def _rounding(cloud: CloudFile) -> str:
    if not cloud.single_precision:
        return ""
    step = float(np.abs(bounds_of(cloud)).max()) * 2.0**-23
    if step <= COARSEST_M:
        return ""
    return (
        f"{cloud.path} stores its coordinates in single precision: they are rounded to {step:.2g}; write them as "
        "doubles, or relative to an origin near the cloud"
    )
