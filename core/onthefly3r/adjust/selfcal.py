"""Self-calibration of the first model: bundle adjustment that keeps the intrinsics near what is known of them.

Free self-calibration over-fits on weak geometry: over flat ground a wrong focal length costs a few hundredths of
a pixel, less than what a rolling shutter or a lens leaves in the residuals. So intrinsics have priors, and
`evidence.py` finds out what the images tell of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.arrays import Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from ..records import Features
from .bundle import Bundle, State
from .evidence import PrincipalPoint, calibrate
from .intrinsics import PARAMETERS, intrinsics_of
from .sparse_model import SparseModel


@dataclass(frozen=True)
class IntrinsicsPrior:
    """What is known of a camera before its images: the mean, and standard deviations of what may deviate.

    Distortions are given as displacements at the image corner, as a fraction of its distance from the centre, so
    that they mean the same for a wide and a narrow lens. The radial displacement has two parts: what remains at
    the corner, which bends a whole block and which weak geometry cannot tell, and the wave between centre and
    corner, which images do tell.
    """

    camera: Camera  # the mean, working size
    focal_sigma: float  # relative
    aspect_sigma: float = 0.003
    corner_sigma: float = 0.005  # of k1 r^2 + k2 r^4 at the corner
    wave_sigma: float = 0.03  # of k2 r^4 at the corner
    tangential_sigma: float = 0.003  # of p1 r and p2 r at the corner
    centre_sigma: float = 0.01  # of the principal point, as a fraction of the longest side

    def mean(self) -> Float:
        """Return the mean (8,) of `PARAMETERS`."""
        return intrinsics_of(self.camera)

    def whitening(self) -> Float:
        """Return the matrix (8, 8) that turns a deviation of `PARAMETERS` into standard deviations."""
        corner = 0.5 * float(np.hypot(self.camera.width / self.camera.fx, self.camera.height / self.camera.fy))
        matrix = np.zeros((len(PARAMETERS),) * 2)
        matrix[0, 0] = 1.0 / self.focal_sigma
        matrix[1, 1] = 1.0 / self.aspect_sigma
        matrix[2, 2:4] = np.array([corner**2, corner**4]) / self.corner_sigma
        matrix[3, 3] = corner**4 / self.wave_sigma
        matrix[4, 4] = matrix[5, 5] = corner / self.tangential_sigma
        longest = max(self.camera.width, self.camera.height)
        matrix[6, 6], matrix[7, 7] = np.array([self.camera.width, self.camera.height]) / longest / self.centre_sigma
        return matrix


@dataclass(frozen=True)
class SelfCalibration:
    """The adjusted model, and per free camera key how well its intrinsics are known."""

    model: SparseModel
    sigma: Mapping[str, Float]  # (8,) posterior standard deviation of PARAMETERS
    shift: Mapping[str, Float]  # (8,) estimate minus prior in prior standard deviations; k1: remainder at the corner
    verdict: Mapping[str, str]  # what became of the principal point, and why
    notes: Mapping[str, float]  # figures for the report


def self_calibrate(
    model: SparseModel,
    features: Mapping[int, Features],
    keys: Mapping[int, str],
    priors: Mapping[str, IntrinsicsPrior],
    held: frozenset[str] = frozenset(),
    principal_point: PrincipalPoint = "auto",
) -> SelfCalibration:
    """Adjust poses, points and the intrinsics of all camera keys outside `held`; the frame stays about the same.

    `model` is best built with the free intrinsics at their priors' means. `priors` holds every key that is free;
    a held key keeps the model's camera. Pixels are of the working images.
    """
    bundle, images = _bundle(model, features, keys, priors, held)
    start = _start(model, images, bundle.free)
    before = np.linalg.norm(bundle.residuals(start), axis=1)
    solved = calibrate(bundle, start, principal_point)
    bundle, state, noise_px = solved.bundle, solved.state, solved.noise_px
    after = np.linalg.norm(bundle.residuals(state), axis=1)
    variance = np.diag(bundle.normal_equations(state, noise_px).shared_covariance())
    sigma = np.sqrt(variance).reshape(-1, len(PARAMETERS))
    return SelfCalibration(
        model=_adjusted(model, bundle, images, state, after),
        sigma=dict(zip(bundle.free, sigma, strict=True)),
        shift=dict(zip(bundle.free, bundle.deviation(state), strict=True)),
        verdict=solved.verdict,
        notes={
            "pixel_noise_px": noise_px,
            "iterations": float(solved.iterations),
            "reprojection_before_px": float(before.mean()),
            "reprojection_after_px": float(after.mean()),
        },
    )


def _bundle(
    model: SparseModel,
    features: Mapping[int, Features],
    keys: Mapping[int, str],
    priors: Mapping[str, IntrinsicsPrior],
    held: frozenset[str],
) -> tuple[Bundle, tuple[int, ...]]:
    images = tuple(sorted(model.local_from_cam))
    image_keys = tuple(keys[i] for i in images)
    free = tuple(sorted(set(image_keys) - held))
    rows, points, pixels = [], [], []
    for row, index in enumerate(images):
        track, camera = model.tracks[index], model.cameras[keys[index]]
        seen = model.local_from_cam[index].inverse().apply(model.points[track.points])
        before = np.isfinite(camera.project(seen)).all(axis=-1)
        # An image that holds two features of one point counts with the first of them.
        chosen = np.unique(track.points[before], return_index=True)[1]
        points.append(track.points[before][chosen])
        pixels.append(features[index].pixels[track.features[before]][chosen].astype(float))
        rows.append(np.full(len(chosen), row))
    image, point = np.concatenate(rows), np.concatenate(points)
    order = np.argsort(point, kind="stable")
    bundle = Bundle(
        image=image[order],
        point=point[order],
        pixel=np.concatenate(pixels)[order],
        weight=np.ones(len(order)),
        keys=image_keys,
        free=free,
        cameras=model.cameras,
        mean=np.array([priors[key].mean() for key in free]).reshape(-1, len(PARAMETERS)),
        whitening=np.array([priors[key].whitening() for key in free]).reshape(-1, len(PARAMETERS), len(PARAMETERS)),
        adjustable=np.ones(len(PARAMETERS), bool),
    )
    return bundle, images


def _start(model: SparseModel, images: tuple[int, ...], free: tuple[str, ...]) -> State:
    return State(
        rotations=np.array([model.local_from_cam[i].rotation for i in images]),
        centres=np.array([model.local_from_cam[i].translation for i in images]),
        points=np.asarray(model.points, float),
        intrinsics=np.array([intrinsics_of(model.cameras[key]) for key in free]).reshape(-1, len(PARAMETERS)),
    )


def _adjusted(
    model: SparseModel, bundle: Bundle, images: tuple[int, ...], state: State, errors_px: Float
) -> SparseModel:
    poses = zip(images, state.rotations, state.centres, strict=True)
    return replace(
        model,
        local_from_cam={index: Rigid3(rotation, centre) for index, rotation, centre in poses},
        cameras={key: bundle.camera(key, state) for key in model.cameras},
        points=state.points,
        reprojection_px=_mean_by_point(bundle.point, errors_px, len(state.points)),
        mean_reprojection_px=float(errors_px.mean()),
    )


def _mean_by_point(point: Int, values: Float, n: int) -> Float:
    return np.asarray(np.bincount(point, values, minlength=n) / np.maximum(np.bincount(point, minlength=n), 1))
