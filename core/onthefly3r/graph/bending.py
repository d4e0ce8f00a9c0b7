"""Bends of local models: what a lens or a network gone slightly wrong does to all that it rebuilds at once.

To second order a smooth bend is a quadric: at an offset r from its middle a local model rises by r' C r / 2 and slopes
by C r. The curvature C is a bowl, a saddle and a twist, which is a saddle turned by 45 degrees. Ground keeps its size,
and every camera stays above the ground that it sees, for its depth is right and neighbouring rays still meet there: h
above the ground, it shifts by -h C r too. Of these, self-calibrated models of parallel photographs are known to dome
(James and Robson, Earth Surface Processes and Landforms 39, 2014, p. 1413).

All views of a local model turn together with its bend, so that a graph of poses, which takes the errors of views for
independent, spreads it over the map. Here the curvatures of each submap are estimated from how it disagrees with others
about the frames they share, as far as they stand out from the noise of views. A bend that all submaps have in common
shows in no disagreement; only positions could tell it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.arrays import Float
from ..geometry.transforms import Rigid3, Sim3, rotation_exp
from ..map.state import MapState
from ..records import Sighting
from .sightings import misfits_at_camera, motion_at_camera, view_noise

FORMS = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])  # bowl, saddle, twist
KIND = np.array([0, 1, 1])  # forms of one kind are drawn equally wide: how a saddle is turned is chance
LEVEL = 0.05  # of the scene's depth: how far cameras are off a plane square to the direction in which they look
OUTLYING = 3.0  # times the noise: views that miss by more were placed wrong, and count the less
ROUNDING = 1e-9  # of what a bend does to the views: less of it left than that is none
WIDE = 10.0  # times what one submap leaves open: the spread of curvatures to begin with
STEPS = 30  # of estimating that spread


@dataclass(frozen=True)
class Sheet:
    """What a submap bends about, in its frame and units."""

    middle: Float  # (3,) of the cameras
    axes: Float  # (3, 3) rows: along, across, and up: away from the scene, square to the plane of the cameras
    height: float  # of the middle above the scene

    def bends(self, centre: Float) -> Float:
        """Return [turn in rad, shift] (6, 3) of a camera at a place (3,), for a curvature of one of each form."""
        *flat, rise = self.axes @ (centre - self.middle)
        slopes = FORMS @ flat  # (3, 2)
        turns = np.column_stack([slopes[:, 1], -slopes[:, 0], np.zeros(3)])
        shifts = np.column_stack([-(self.height + rise) * slopes, 0.5 * slopes @ flat])
        return np.vstack([self.axes.T @ turns.T, self.axes.T @ shifts.T])

    def straighten(self, centre: Float, curvatures: Float) -> Sim3:
        """Return straight_from_bent for what a camera at a place (3,) sees."""
        turn, shift = np.split(-self.bends(centre) @ curvatures, 2)
        rotation = rotation_exp(turn)
        return Sim3(1.0, rotation, centre + shift - rotation @ centre)


def sheets(state: MapState) -> dict[int, Sheet]:
    """Return the sheet of every submap: its cameras, new ones and references, and how far below them the scene is."""
    poses: dict[int, list[Rigid3]] = {}
    depths: dict[int, list[float]] = {}
    for frame in state.frames.values():
        poses.setdefault(frame.submap, []).append(frame.submap_from_cam)
        depths.setdefault(frame.submap, []).extend([frame.depth] if frame.depth else [])
    own = set(depths)
    for seen in state.sightings:
        poses.setdefault(seen.submap, []).append(seen.submap_from_cam)
        if seen.submap not in own:  # it joined two fragments, and has no new frames: it is as far off as what it saw
            depth = state.frames[seen.frame].depth / seen.frame_from_submap.scale
            depths.setdefault(seen.submap, []).extend([depth] if depth else [])
    return {submap: sheet(poses[submap], float(np.median(known)) if known else 0.0) for submap, known in depths.items()}


def sheet(poses: Sequence[Rigid3], depth: float) -> Sheet:
    """Return the sheet of cameras that see the scene at a depth along their axes.

    Cameras along a line leave its roll open, one camera everything: there `up` is against the direction of view. Where
    cameras look all round, there is no height, and what is left of a bend is its turns and its rise.
    """
    centres = np.array([pose.translation for pose in poses])
    view = np.mean([pose.rotation[:, 2] for pose in poses], axis=0)
    offsets = centres - centres.mean(axis=0)
    spread = offsets.T @ offsets + len(poses) * (LEVEL * depth) ** 2 * (np.eye(3) - np.outer(view, view))
    up = np.linalg.eigh(spread)[1][:, 0]
    slant = float(up @ view)
    up = up if slant < 0.0 else -up
    along = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    along /= np.linalg.norm(along)
    return Sheet(centres.mean(axis=0), np.stack([along, np.cross(up, along), up]), depth * abs(slant))


@dataclass(frozen=True)
class Bending:
    """How much every submap is bent."""

    sheet_of: Mapping[int, Sheet]
    curvatures_of: Mapping[int, Float]  # (3,) of each form, per unit of the submap

    def straight_from_bent(self, submap: int, centre: Float) -> Sim3:
        """Return what straightens the surroundings of a camera at a place (3,) in a submap."""
        return self.sheet_of[submap].straighten(centre, self.curvatures_of[submap])

    def straightened(self, sightings: Sequence[Sighting]) -> list[Sighting]:
        """Return sightings as the submaps would have them if they were not bent."""
        straight = []
        for seen in sightings:
            straight_from_bent = self.straight_from_bent(seen.submap, seen.submap_from_cam.translation)
            straight.append(replace(seen, frame_from_submap=seen.frame_from_submap @ straight_from_bent.inverse()))
        return straight


def found_so_far(state: MapState) -> Bending:
    """Return how bent the submaps of a map were found; those that are new are taken to be flat."""
    sheet_of = sheets(state)
    return Bending(sheet_of, {submap: state.curvatures_of.get(submap, np.zeros(3)) for submap in sheet_of})


def estimate(
    nodes: Mapping[int, Sim3], sightings: Sequence[Sighting], so_far: Bending, least_position: float
) -> Bending:
    """Return the most likely curvatures of each submap, given where the frames are.

    Curvatures are drawn around zero; how widely is estimated with them (empirical Bayes), so that none is made up where
    the misfits show none.

    Args:
        nodes: submaps and frames in the map, numbered as in the pose graph.
        sightings: as the submaps have them, bent.
        so_far: what each submap bends about, and the bends by which wrong views are told from bent ones.
        least_position: least noise of a camera's position that is believed, map units.
    """
    misfits = misfits_at_camera(nodes, sightings)
    left = misfits_at_camera(nodes, so_far.straightened(sightings))
    sigmas = view_noise(left, sightings, least_position).sigmas
    length = np.sqrt(((left / sigmas) ** 2).mean(axis=1))
    weights = np.sqrt(np.minimum(1.0, OUTLYING / np.maximum(length, 1e-12)))
    rows_of: dict[int, list[int]] = {}
    for row, seen in enumerate(sightings):
        rows_of.setdefault(seen.submap, []).append(row)
    told = [
        _told(
            misfits[rows] / sigmas * weights[rows, None],
            weights[rows, None] / sigmas,
            [sightings[row].submap_from_cam.translation for row in rows],
            so_far.sheet_of[submap],
            nodes[submap].scale,
        )
        for submap, rows in rows_of.items()
    ]
    found = _most_likely(np.array([information for information, _ in told]), np.array([toward for _, toward in told]))
    in_map = dict.fromkeys(so_far.sheet_of, np.zeros(3)) | dict(zip(rows_of, found, strict=True))
    return Bending(so_far.sheet_of, {submap: nodes[submap].scale * curvatures for submap, curvatures in in_map.items()})


def _told(missed: Float, whitening: Float, centres: Sequence[Float], sheet: Sheet, scale: float) -> tuple[Float, Float]:
    """Return what the whitened misfits (N, 7) of a submap's cameras tell of its curvatures per map unit.

    Information (3, 3), and information times curvatures (3,).
    """
    in_map = np.array([1.0] * 3 + [scale] * 3 + [1.0])[:, None]
    # 1 per map unit is `scale` per unit of the submap.
    bent = np.array([scale * in_map * np.vstack([sheet.bends(centre), np.zeros(3)]) for centre in centres])
    moved = np.array([in_map * motion_at_camera(centre) for centre in centres])
    bends, moves = ((part * whitening[:, :, None]).reshape(-1, part.shape[2]) for part in (bent, moved))
    # What moving the submap as a whole explains says nothing of its bend.
    basis = np.linalg.qr(moves)[0]
    shape = bends - basis @ (basis.T @ bends)
    shape[:, (shape**2).sum(axis=0) < ROUNDING * (bends**2).sum(axis=0)] = 0.0
    return shape.T @ shape, shape.T @ missed.ravel()


def _most_likely(information: Float, toward: Float) -> Float:
    """Return the means (N, 3) of curvatures drawn around zero, of which so much is told; how widely they are drawn too.

    Expectation-maximisation, from a spread that hides nothing.
    """
    told = np.einsum("nii->ni", information)
    found = np.zeros_like(toward)
    if not told.any():
        return found
    variance = np.full(3, WIDE / np.median(told[told > 0.0]))
    for _ in range(STEPS):
        left = np.linalg.inv(information + np.diag(1.0 / variance))
        found = np.einsum("nij,nj->ni", left, toward)
        drawn = (found**2 + np.einsum("nii->ni", left)).mean(axis=0)
        variance = np.array([drawn[kind == KIND].mean() for kind in KIND])
    return found
