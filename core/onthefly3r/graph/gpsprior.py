"""GPS in the map: a running tie of map and positions, priors for the pose graph, and a vote on new images.

Positions never place an image. They keep a map that is larger than a local model from bending, as far as their own
accuracy goes, and ask for a second opinion where a new image lands far from where it says it was taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..earth.levelfit import fit
from ..earth.positions import Positions, usable_positions
from ..earth.updirection import up_witnesses
from ..geometry.arrays import Float, Int
from ..geometry.transforms import Sim3, rotation_exp, skew
from ..map.state import MapState
from ..options import GeoreferenceOptions
from ..records import GpsFix, Shot
from .solver import PosePrior

MIN_POSITIONS = 12
MAX_FITTED = 300  # positions that the tie is estimated from, evenly spread over the map
MIN_USED_SHARE = 0.5
MIN_SIDEWAYS = 0.1  # sideways over lengthwise extent: along one line positions leave the roll open
MIN_EXTENT = 5.0  # sideways, in sigmas of the positions: nearer together they say nothing of the map's shape
HUBER = 1.345
PRIOR_STEPS = 8
SETTLED = 1e-6
MAX_STEP = 0.2  # rad, or of the logarithm of scale, at a time: positions of one place tell nothing of either
MIN_EIGENVALUE = 1e-4  # of the largest: directions of a submap that its positions do not determine
# Of the extent of a submap's cameras, or rad: what positions know worse than that the map knows better. The roll of a
# strip follows from how far the cameras are off its line, which is little more than noise.
MAX_SIGMA = 0.05
VOTE_SIGMAS = 5.0
VOTE_SHARE = 0.2  # of the distance to the references, by which the map may be warped or turned here


@dataclass(frozen=True)
class GpsTie:
    """Where the map is on Earth as of now, and how far its positions scatter about it from image to image."""

    enu_from_map: Sim3
    positions: Positions
    noise_m: Float  # (2,) horizontal per axis, vertical


def tie_to_positions(state: MapState, shots: Mapping[int, Shot], options: GeoreferenceOptions) -> GpsTie | None:
    """Return the tie of the present map to the positions of its images; None where they cannot say enough."""
    positions = usable_positions(sorted(state.frames), shots, options)
    if positions.distinct < MIN_POSITIONS:
        return None
    sample = _rows(positions, np.unique(np.linspace(0, len(positions.images) - 1, MAX_FITTED).astype(int)))
    poses = {i: state.map_from_cam(i) for i in sample.images}
    first_up, witnesses = up_witnesses(poses, shots, None)
    solution = fit(np.array([pose.translation for pose in poses.values()]), sample, first_up, witnesses, seed=0)
    used = sample.enu[solution.inlier_h]
    if len(used) < max(MIN_POSITIONS, MIN_USED_SHARE * len(sample.images)):
        return None
    lengthwise, sideways, _ = np.linalg.svd(used - used.mean(axis=0), compute_uv=False) / np.sqrt(len(used))
    if sideways < MIN_SIDEWAYS * lengthwise:
        return None
    centres = np.array([state.map_from_cam(i).translation for i in positions.images])
    residuals = positions.enu - solution.enu_from_map.apply(centres)
    steps = np.abs(np.diff(residuals[positions.order], axis=0)) / np.sqrt(2.0)
    scatter = 1.4826 * np.median(steps, axis=0)
    noise_m = np.array([scatter[:2].max(), scatter[2]])
    if sideways < MIN_EXTENT * max(noise_m[0], float(np.median(sample.sigma_h_m))):
        return None
    return GpsTie(solution.enu_from_map, positions, noise_m)


def pose_priors(state: MapState, tie: GpsTie, shots: Mapping[int, Shot]) -> list[PosePrior]:
    """Return what the positions of its images say about each submap.

    Receivers err alike within a batch, so that the images of a submap share the weight of one position; what
    scatters from image to image does average out. Heights count only where the tags state how precise they are:
    consumer receivers drift by tens of metres in height during a flight.
    """
    scale, rotation = tie.enu_from_map.scale, tie.enu_from_map.rotation
    map_positions = tie.enu_from_map.inverse().apply(tie.positions.enu)
    rows_of: dict[int, list[int]] = {}
    for row, index in enumerate(tie.positions.images):
        rows_of.setdefault(state.frames[index].submap, []).append(row)
    priors = []
    for submap, rows in rows_of.items():
        variance_h = len(rows) * tie.positions.sigma_h_m[rows] ** 2 + tie.noise_m[0] ** 2
        variance_v = len(rows) * tie.positions.sigma_v_m[rows] ** 2 + tie.noise_m[1] ** 2
        images = [tie.positions.images[row] for row in rows]
        stated = np.array([_states_height(shots[i].gps) for i in images])
        weight = np.stack([1.0 / variance_h, 1.0 / variance_h, stated / variance_v], axis=-1) * scale**2
        points = np.array([state.frames[i].submap_from_cam.translation for i in images])
        root = np.sqrt(weight)[:, :, None] * rotation  # whitens map residuals, (n, 3, 3)
        priors.append(_prior(submap, state.map_from_submap[submap], points, map_positions[rows], root))
    return [prior for prior in priors if prior is not None]


def gps_disagreement(
    index: int, centre: Float, references: Mapping[int, Float], shots: Mapping[int, Shot], tie: GpsTie
) -> float:
    """Return how far an image lands from where its position says, over what is allowed; 0 where nothing can be said.

    The references' own offsets are taken off, so that drift of the map and bias of the receiver do not count.

    Args:
        index: of the new image.
        centre: (3,) where it would be placed, map frame.
        references: centres (3,) of the references, map frame.
        shots: for the positions.
        tie: of map and positions.
    """
    fix = shots[index].gps
    located = {i: shots[i].gps for i in references if shots[i].gps is not None}
    if fix is None or not located:
        return 0.0
    measured = _horizontal([fix, *(f for f in located.values() if f is not None)], tie)
    placed = tie.enu_from_map.apply(np.array([centre, *(references[i] for i in located)]))[:, :2]
    offsets = measured - placed
    offset = float(np.linalg.norm(offsets[0] - np.median(offsets[1:], axis=0)))
    distance = float(np.median(np.linalg.norm(measured[1:] - measured[0], axis=1)))
    sigma = float(np.hypot(fix.sigma_h_m or np.median(tie.positions.sigma_h_m), tie.noise_m[0]))
    return offset / float(VOTE_SIGMAS * np.sqrt(2.0) * sigma + VOTE_SHARE * distance)


def _states_height(fix: GpsFix | None) -> bool:
    return fix is not None and fix.height_m is not None and fix.sigma_v_m is not None


def _horizontal(fixes: Sequence[GpsFix], tie: GpsTie) -> Float:
    frame = tie.positions.frame
    return frame.from_geographic(np.array([[f.lat_deg, f.lon_deg, frame.height_m] for f in fixes]))[:, :2]


def _rows(positions: Positions, rows: Int) -> Positions:
    """Return some of the positions."""
    order = np.argsort(np.argsort(positions.order, kind="stable")[rows], kind="stable")
    return replace(
        positions,
        images=tuple(positions.images[row] for row in rows),
        enu=positions.enu[rows],
        sigma_h_m=positions.sigma_h_m[rows],
        sigma_v_m=positions.sigma_v_m[rows],
        has_height=positions.has_height[rows],
        flight=positions.flight[rows],
        order=order,
        distinct=len(np.unique(positions.enu[rows], axis=0)),
    )


def _prior(submap: int, pose: Sim3, points: Float, targets: Float, root: Float) -> PosePrior | None:
    """Return pose and information (7, 7) of a submap as its cameras' positions suggest, None where they say nothing.

    A right perturbation [w, u, lambda] of the pose moves a point p by s R (w x p + u + lambda p). It is estimated
    about the middle of the points and in units of their extent (of what positions tell from each other, where that is
    more), where what they determine stands apart from what they leave open; that stays as it is, and carries no weight.
    """
    middle = points.mean(axis=0)
    centred = points - middle
    sigma = 1.0 / (pose.scale * float(np.linalg.norm(root, ord=2, axis=(1, 2)).max()))
    extent = max(float(np.sqrt((centred**2).sum(axis=1).mean())), 2.0 * sigma / MAX_SIGMA)
    # u' = (u + w x middle + lambda middle) / extent
    from_origin = np.eye(7)
    from_origin[3:6] = np.column_stack([-skew(middle), np.eye(3), middle]) / extent
    motion = np.stack([np.column_stack([-skew(p), extent * np.eye(3), p]) for p in centred])
    for _ in range(PRIOR_STEPS):
        jacobian = root @ (pose.scale * pose.rotation) @ motion
        residual = np.einsum("nij,nj->ni", root, targets - pose.apply(points))
        length = np.linalg.norm(residual, axis=1)
        weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-12))
        information = np.einsum("n,nki,nkj->ij", weight, jacobian, jacobian)
        gradient = np.einsum("n,nki,nk->i", weight, jacobian, residual)
        values, vectors = np.linalg.eigh(information)
        known = values > max(MIN_EIGENVALUE * values[-1], MAX_SIGMA**-2)
        if not known.any():  # far off, alone
            return None
        values, vectors = values[known], vectors[:, known]
        step = vectors @ ((vectors.T @ gradient) / values)
        step = step * min(1.0, MAX_STEP / max(float(np.abs(step[[0, 1, 2, 6]]).max()), 1e-12))
        step = np.linalg.solve(from_origin, step)
        pose = pose @ Sim3(float(np.exp(step[6])), rotation_exp(step[:3]), step[3:6])
        if np.abs(step).max() < SETTLED:
            break
    information = from_origin.T @ ((vectors * values) @ vectors.T) @ from_origin
    return PosePrior(submap, pose, np.asarray(information), middle)
