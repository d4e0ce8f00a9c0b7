"""The parts of a map that nothing connects: each laid out by its own positions, and told apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..earth.control_reference import earth_reference
from ..earth.georef import georeference, world_frame
from ..earth.ground import ground_normal
from ..errors import GeoreferenceError
from ..geometry.arrays import Float
from ..geometry.transforms import Sim3
from ..geometry.umeyama import weighted_similarity
from ..map.state import MapState
from ..options import GeoreferenceOptions
from ..records import GeoReference, Rejection, Shot

# Four points that fix how two frames on the Earth lie to each other, m.
CORNERS = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]])


def main_part(state: MapState) -> MapState:
    """Return the largest fragment of a map as a map of its own."""
    return state.part(next(iter(state.fragments()), 0))


def main_reference(
    state: MapState, shots: Mapping[int, Shot], options: GeoreferenceOptions, up: Float | None
) -> GeoReference:
    """Return how the largest fragment lies on the Earth; raises what `georeference` raises."""
    main = main_part(state)
    return earth_reference(state.tie, {i: main.map_from_cam(i) for i in main.frames}, shots, options, up)


def laid_out(
    state: MapState, shots: Mapping[int, Shot], options: GeoreferenceOptions, reference: GeoReference | None
) -> tuple[MapState, GeoReference | None, dict[int, Rejection], list[str]]:
    """Bring the other fragments into the frame of the largest one, each by its own positions.

    Returns the map of what can be delivered, the georeference with the residuals of all its parts, why the frames of
    other fragments are not in it, and what the user should know.
    """
    fragments = state.fragments()
    if len(fragments) < 2:
        return state, reference, {}, []
    main, *others = fragments
    delivered, warnings = [main], list[str]()
    lost: dict[int, Rejection] = {}
    for label in others:
        part, frames = state.part(label), fragments[label]
        try:
            if reference is None:
                raise GeoreferenceError("local coordinates have no common frame for parts that are not connected")
            poses = {i: part.map_from_cam(i) for i in frames}
            own = georeference(poses, shots, options, ground_normal(part))
        except GeoreferenceError as error:
            numbers = {"photographs": float(len(frames))}
            reason = f"reconstructed with {len(frames) - 1} others apart from the rest, and no place is known: {error}"
            lost |= {i: Rejection((i,), "fragments", reason, numbers) for i in frames}
            warnings.append(
                f"a part of {len(frames)} photographs is not connected to the rest and cannot be placed by its "
                f"positions; it is left out. {_between(fragments[main], frames, shots)}"
            )
            continue
        state.shift(label, reference.enu_from_map.inverse() @ _enu_from_enu(reference, own) @ own.enu_from_map)
        reference = replace(reference, residuals_m={**reference.residuals_m, **own.residuals_m})
        delivered.append(label)
        warnings.append(
            f"two parts are not connected: {len(frames)} photographs lie by their own positions only, within the "
            f"accuracy of these. {_between(fragments[main], frames, shots)}"
        )
    return state.parts(delivered), reference, lost, warnings


def _enu_from_enu(reference: GeoReference, other: GeoReference) -> Sim3:
    here, there = world_frame(reference).enu, world_frame(other).enu
    moved = here.from_geographic(there.to_geographic(CORNERS))
    return weighted_similarity(CORNERS, moved, np.ones(len(CORNERS)))


def _between(first: list[int], second: list[int], shots: Mapping[int, Shot]) -> str:
    """Say between which photographs of two parts more are needed: the nearest by position, if there are any."""
    places = [[(i, fix) for i in part if (fix := shots[i].gps) is not None] for part in (first, second)]
    if not all(places):
        return "Fly once more between them."
    table = [np.array([[fix.lat_deg, fix.lon_deg] for _, fix in part]) for part in places]
    stretch = np.array([1.0, np.cos(np.radians(table[0][0, 0]))])
    distance = np.linalg.norm((table[0][:, None] - table[1][None]) * stretch, axis=2)
    row, column = np.unravel_index(int(distance.argmin()), distance.shape)
    names = shots[places[0][int(row)][0]].name, shots[places[1][int(column)][0]].name
    return f"Fly once more between {names[0]} and {names[1]}."
