"""How submaps saw frames: what the pose graph is made of, and how well a view is known within its local model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Sim3, rotation_log, skew
from ..map.state import MapState
from ..records import Edge, Sighting

FRAMES = 2**32  # nodes of frames are numbered from here, those of submaps from 0
# Median of the mean square of three standard normal variables, and of the square of one.
MEDIAN_OF_THREE, MEDIAN_OF_ONE = 0.789, 0.455
LEAST_NOISE = 1e-6  # rad, spacings, of the logarithm of scale: rounding is no measure of anything


@dataclass(frozen=True)
class ViewNoise:
    """Standard deviations, per axis, of a view within its local model."""

    rotation_rad: float
    position: float  # of the camera, map units
    log_scale: float

    @property
    def sigmas(self) -> Float:
        """In the order of a misfit (7,): rotation, position, log scale."""
        return np.array([self.rotation_rad] * 3 + [self.position] * 3 + [self.log_scale])


def shared_sightings(state: MapState) -> list[Sighting]:
    """Return all sightings of the frames that more than one submap saw, that by their own submap among them."""
    own = {seen.frame: state.frames[seen.frame] for seen in state.sightings}
    first = [Sighting(i, frame.submap, Sim3(), frame.submap_from_cam) for i, frame in own.items()]
    return first + state.sightings


def fitted(sightings: Sequence[Sighting]) -> int:
    """Return how many sightings it takes to fix all frames and submaps that they join to one another."""
    return len({seen.frame for seen in sightings}) + len({seen.submap for seen in sightings}) - 1


def misfits_at_camera(nodes: Mapping[int, Sim3], sightings: Sequence[Sighting]) -> Float:
    """Return [rotation rad, position in map units, log scale] (N, 7) by which submaps' views miss the frames.

    In the axes of the submap, about the camera.
    """
    steps = np.empty((len(sightings), 7))
    for row, seen in enumerate(sightings):
        submap = nodes[seen.submap]
        frame_from_submap = nodes[FRAMES + seen.frame].inverse() @ submap
        centre = Sim3(1.0, np.eye(3), seen.submap_from_cam.translation)
        steps[row] = tangent(centre.inverse() @ seen.frame_from_submap.inverse() @ frame_from_submap @ centre)
        steps[row, 3:6] *= submap.scale
    return steps


def view_noise(misfits: Float, sightings: Sequence[Sighting], least_position: float) -> ViewNoise:
    """Return what the misfits (N, 7) of the sightings show of the noise of one view.

    Medians, so that views placed wrong do not count. Where frames and submaps follow few sightings, these fit better
    than they are good: the unknowns' share is added.
    """
    grow = np.sqrt(len(sightings) / max(len(sightings) - fitted(sightings), 1))
    rotation, position = (
        np.sqrt(np.median((misfits[:, k : k + 3] ** 2).mean(axis=1)) / MEDIAN_OF_THREE) for k in (0, 3)
    )
    log_scale = np.sqrt(np.median(misfits[:, 6] ** 2) / MEDIAN_OF_ONE)
    return ViewNoise(
        rotation_rad=max(float(grow * rotation), LEAST_NOISE),
        position=max(float(grow * position), least_position),
        log_scale=max(float(grow * log_scale), LEAST_NOISE),
    )


def view_edge(seen: Sighting, scale: float, noise: ViewNoise) -> Edge:
    """Return the edge from a frame to a submap that saw it; `scale` is that of the submap in the map."""
    return Edge(FRAMES + seen.frame, seen.submap, seen.frame_from_submap, _view_covariance(seen, scale, noise))


def submap_edges(sightings: Sequence[Sighting], state: MapState, noise: ViewNoise) -> list[Edge]:
    """Return, for each frame seen again, the relative pose of its own submap and the one that saw it again.

    `sightings` are those of `shared_sightings`.
    """
    own = {seen.frame: seen for seen in sightings if seen.submap == state.frames[seen.frame].submap}
    edges = []
    for seen in sightings:
        first = own[seen.frame]
        if seen.submap != first.submap:
            # Both views err: as much as two in the target's units.
            covariance = 2.0 * _view_covariance(seen, state.map_from_submap[seen.submap].scale, noise)
            relative = first.frame_from_submap.inverse() @ seen.frame_from_submap
            edges.append(Edge(first.submap, seen.submap, relative, covariance))
    return edges


def motion_at_camera(centre: Float) -> Float:
    """Return how [rotation, translation, log scale] of a submap move a view at a place (3,) in it: (7, 7).

    A point p moves by w x p + u + lambda p.
    """
    motion = np.eye(7)
    motion[3:6, :3] = -skew(centre)
    motion[3:6, 6] = centre
    return motion


def tangent(transform: Sim3) -> Float:
    """Return [rotation rad, translation, log scale] (7,) of a transform near the identity."""
    return np.array([*rotation_log(transform.rotation), *transform.translation, np.log(transform.scale)])


def _view_covariance(seen: Sighting, scale: float, noise: ViewNoise) -> Float:
    """Covariance (7, 7) of [rotation, translation, log scale], right perturbation in the submap's frame.

    The camera turns about its own centre c: a point p moves by w x (p - c) + u + lambda (p - c).
    """
    to_origin = motion_at_camera(-seen.submap_from_cam.translation)
    in_submap = np.array([1.0] * 3 + [scale] * 3 + [1.0])
    return np.asarray((to_origin * (noise.sigmas / in_submap) ** 2) @ to_origin.T)
