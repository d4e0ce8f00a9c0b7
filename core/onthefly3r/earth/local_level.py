"""A local frame without a CRS: level and metric by the same evidence as on the Earth, as far as there is any."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..errors import GeoreferenceError
from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, nearest_rotation
from ..options import GeoreferenceOptions
from ..records import EarthTie, GeoReference, Shot
from .control_reference import earth_reference
from .georef import metres_per_map_unit
from .updirection import up_witnesses

SCALE_DISAGREES = 0.1  # relative, between positions and a metric local reconstructor


@dataclass(frozen=True)
class LocalFrame:
    """From the map to levelled coordinates."""

    level_from_map: Sim3
    metric: bool  # whether the unit is the metre
    reference: GeoReference | None  # the fit to positions or control that it comes from
    warnings: tuple[str, ...] = ()


def local_frame(
    tie: EarthTie | None,
    map_from_cam: Mapping[int, Rigid3],
    shots: Mapping[int, Shot],
    options: GeoreferenceOptions,
    ground_normal: Float | None,
    stated_metres_per_unit: float | None = None,
) -> LocalFrame:
    """Return the frame of local coordinates: the fit to positions where they suffice, else level and scale apart.

    Args:
        tie: of an adjusted map.
        map_from_cam: poses of the placed cameras, map frame.
        shots: their tags.
        options: accuracies of positions.
        ground_normal: (3,) away from the ground, map frame.
        stated_metres_per_unit: what a metric local reconstructor says of the scale, None if it is not metric.
    """
    try:
        reference = earth_reference(tie, map_from_cam, shots, options, ground_normal)
    except GeoreferenceError:
        up, _ = up_witnesses(map_from_cam, shots, ground_normal)
        measured = metres_per_map_unit(map_from_cam, shots, options)
        scale = measured or stated_metres_per_unit
        warnings = () if scale else ("no positions tell the scale: the units of the local frame are not metres",)
        return LocalFrame(Sim3(scale or 1.0, turning_up(up), np.zeros(3)), scale is not None, None, warnings)
    return LocalFrame(reference.enu_from_map, True, reference)


def scale_warning(reference: GeoReference, stated_metres_per_unit: float | None) -> str:
    """Return what to say where a metric local reconstructor and the positions disagree on the scale; empty if not."""
    if stated_metres_per_unit is None:
        return ""
    ratio = reference.enu_from_map.scale / stated_metres_per_unit
    if abs(np.log(ratio)) < SCALE_DISAGREES:
        return ""
    return (
        f"the positions make the survey {ratio:.2f} times as large as the local reconstructor does, which measures in "
        "metres; check the positions"
    )


def turning_up(up: Float) -> Float:
    """Return the shortest rotation (3, 3) that brings `up` to the third axis."""
    third = np.asarray(up, float) / np.linalg.norm(up)
    first = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = first - (first @ third) * third
    first = first / np.linalg.norm(first)
    return nearest_rotation(np.stack([first, np.cross(third, first), third]))
