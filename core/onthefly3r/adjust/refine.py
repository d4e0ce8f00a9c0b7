"""Refinement: one bundle adjustment of all placed cameras over the features that the local models tied together.

A pose graph knows cameras only, one by one. Where the backbone tells which features of which images it
saw as one point, those tracks join across submaps and fix every camera and the shared intrinsics at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.arrays import Bool
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3, Sim3
from ..records import Observations, PlacedMap, Shot
from .bundle import Bundle, State
from .evidence import Calibrated, PrincipalPoint, calibrate
from .intrinsics import PARAMETERS, intrinsics_of
from .selfcal import IntrinsicsPrior
from .tracks import Tracks, chosen_tracks, images_of, joined_tracks, only

MIN_IMAGES = 3
NO_WORSE = 1.02  # times the median error before: a map that has settled already may come out a hair above it
ABSURD = 0.1  # of the image's longest side: an observation that starts farther off is a mismatch


@dataclass(frozen=True)
class Refinement:
    """Refined cameras: for each image the similarity that takes its submap's frame to the map, and the intrinsics."""

    map_from_submap: Mapping[int, Sim3]  # by shot index
    calibrations: Mapping[str, Camera]  # by camera key, photograph size
    notes: Mapping[str, Any]  # JSON values for the report


@dataclass(frozen=True)
class Block:
    """A map as a bundle: the chosen tracks, the images that share enough of them, and where all starts."""

    tracks: Tracks
    images: tuple[int, ...]  # shot index of every row of the bundle
    bundle: Bundle
    start: State


def refine(
    state: PlacedMap,
    observed: Iterable[tuple[int, Observations]],
    shots: Mapping[int, Shot],
    principal_point: PrincipalPoint = "auto",
) -> Refinement | None:
    """Adjust all cameras that share enough tracks; None when there are none (neural backbones), or it does not settle.

    Args:
        state: the map; it is only read.
        observed: observations by number of the submap that made them.
        shots: at least those of the map.
        principal_point: whether that of the cameras is free, held in the middle, or as the evidence says.
    """
    block = block_of(state, observed, shots)
    solved = None if block is None else calibrated(block, principal_point)
    return None if block is None or solved is None else refinement(block, solved, state)


def block_of(state: PlacedMap, observed: Iterable[tuple[int, Observations]], shots: Mapping[int, Shot]) -> Block | None:
    """Return the map as a bundle, None where fewer than three images share enough tracks."""
    tracks = chosen_tracks(joined_tracks(state, observed), state.frames)
    if len(images_of(tracks)) < MIN_IMAGES:
        return None
    tracks = only(tracks, _plausible(tracks, state, shots))
    images = images_of(tracks)
    if len(images) < MIN_IMAGES:
        return None
    bundle = bundle_of(tracks, images, state, shots)
    return Block(tracks, images, bundle, start_of(tracks, images, state, bundle.free))


def calibrated(block: Block, principal_point: PrincipalPoint) -> Calibrated | None:
    """Return the block adjusted to its tracks alone, None when it does not settle or tracks agree no better."""
    try:
        solved = calibrate(block.bundle, block.start, principal_point)
    except (np.linalg.LinAlgError, RuntimeError):  # singular: numpy's word for it and SuperLU's
        return None
    before, after = (median_error_px(block.bundle, s) for s in (block.start, solved.state))
    return solved if after <= NO_WORSE * before else None


def median_error_px(bundle: Bundle, state: State) -> float:
    """Return the median reprojection error in pixels."""
    return float(np.median(np.linalg.norm(bundle.residuals(state), axis=1)))


def refinement(block: Block, solved: Calibrated, state: PlacedMap) -> Refinement:
    """Return what an adjusted block, in the frame of the map, means for the frames of the map."""
    moved = _moved_frames(block.tracks, block.images, state, solved.state)
    return Refinement(
        map_from_submap=_with_followers(moved, state),
        calibrations={key: solved.bundle.camera(key, solved.state) for key in solved.bundle.free},
        notes={
            "refined_images": float(len(moved)),
            "refined_points": float(len(block.tracks.points)),
            "reprojection_before_px": median_error_px(block.bundle, block.start),
            "reprojection_after_px": median_error_px(block.bundle, solved.state),
            "principal_point": dict(solved.verdict),
        },
    )


def _plausible(tracks: Tracks, state: PlacedMap, shots: Mapping[int, Shot]) -> Bool:
    """Return which observations (M,) lie in front of their cameras and not absurdly far from where they should be."""
    images = images_of(tracks)
    bundle = bundle_of(tracks, images, state, shots)
    residual = np.linalg.norm(bundle.residuals(start_of(tracks, images, state, bundle.free)), axis=1)
    longest = np.array([max(shots[i].width_px, shots[i].height_px) for i in images])
    # False where the residual is NaN, behind the camera.
    return np.asarray(residual <= ABSURD * longest[np.searchsorted(np.array(images), tracks.image)])


def bundle_of(tracks: Tracks, images: tuple[int, ...], state: PlacedMap, shots: Mapping[int, Shot]) -> Bundle:
    """Return the tracks as a bundle, photographs at full size, one row for each of the images, all free."""
    row = np.searchsorted(np.array(images), tracks.image)
    keys = tuple(shots[i].camera_key for i in images)
    free = tuple(sorted(set(keys) & set(state.calibrations)))
    priors = [prior_of(next(shots[i] for i in images if shots[i].camera_key == key)) for key in free]
    return Bundle(
        image=row,
        point=tracks.point,
        pixel=tracks.pixel,
        weight=np.ones(len(row)),
        keys=keys,
        free=free,
        cameras={**{shots[i].camera_key: _camera(i, state, shots) for i in images}},
        mean=np.array([prior.mean() for prior in priors]).reshape(-1, len(PARAMETERS)),
        whitening=np.array([prior.whitening() for prior in priors]).reshape(-1, len(PARAMETERS), len(PARAMETERS)),
        adjustable=np.ones(len(PARAMETERS), bool),
    )


def prior_of(shot: Shot) -> IntrinsicsPrior:
    """Return what a photograph's tags tell of its camera, photograph size."""
    focal = shot.focal_ratio * max(shot.width_px, shot.height_px)
    camera = Camera(shot.width_px, shot.height_px, focal, focal, shot.width_px / 2, shot.height_px / 2)
    return IntrinsicsPrior(camera, shot.focal_ratio_sigma)


def _camera(index: int, state: PlacedMap, shots: Mapping[int, Shot]) -> Camera:
    frame, shot = state.frames[index], shots[index]
    return frame.camera.through(frame.grid_from_photo.inverse(), shot.width_px, shot.height_px)


def start_of(tracks: Tracks, images: tuple[int, ...], state: PlacedMap, free: tuple[str, ...]) -> State:
    """Return the state of a bundle as the map has it."""
    poses = [state.map_from_cam(i) for i in images]
    return State(
        rotations=np.array([pose.rotation for pose in poses]),
        centres=np.array([pose.translation for pose in poses]),
        points=tracks.points,
        intrinsics=np.array([intrinsics_of(state.calibrations[key]) for key in free]).reshape(-1, len(PARAMETERS)),
    )


def _moved_frames(tracks: Tracks, images: tuple[int, ...], state: PlacedMap, adjusted: State) -> dict[int, Sim3]:
    """Return for each image the similarity under which its own prediction has the refined pose and depths."""
    row = np.searchsorted(np.array(images), tracks.image)
    offset = adjusted.points[tracks.point] - adjusted.centres[row]
    ratio = np.einsum("mi,mi->m", offset, adjusted.rotations[row][:, :, 2]) / tracks.depth
    moved = {}
    for k, index in enumerate(images):
        own = ratio[(row == k) & np.isfinite(ratio)]
        local = state.frames[index].submap_from_cam
        scale = float(np.median(own)) if len(own) else state.submap_pose_of(index).scale
        if scale > 0.0:
            moved[index] = _similarity(scale, Rigid3(adjusted.rotations[k], adjusted.centres[k]), local)
    return moved


def _similarity(scale: float, map_from_cam: Rigid3, submap_from_cam: Rigid3) -> Sim3:
    rotation = map_from_cam.rotation @ submap_from_cam.rotation.T
    return Sim3(scale, rotation, map_from_cam.translation - scale * rotation @ submap_from_cam.translation)


def _with_followers(moved: Mapping[int, Sim3], state: PlacedMap) -> dict[int, Sim3]:
    """Let the images that were not adjusted follow the nearest one that was, of their own submap where there is one."""
    if not moved:
        return {}
    refined = np.array(sorted(moved))
    centres = np.array([state.map_from_cam(int(i)).translation for i in refined])
    submaps = np.array([state.frames[int(i)].submap for i in refined])
    followed = dict(moved)
    for index, frame in state.frames.items():
        if index not in moved:
            distance = np.linalg.norm(centres - state.map_from_cam(index).translation, axis=1)
            nearest = int(refined[np.lexsort((distance, submaps != frame.submap))[0]])
            change = moved[nearest] @ state.submap_pose_of(nearest).inverse()
            followed[index] = change @ state.submap_pose_of(index)
    return followed
