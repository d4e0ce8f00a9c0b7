"""Self-calibration of the first model: bundle adjustment that keeps the intrinsics near what is known of them.

Free self-calibration over-fits on weak geometry: over flat ground a wrong focal length costs a few hundredths of
a pixel, less than what a rolling shutter or a lens leaves in the residuals. The maximum a posteriori estimate has
two remedies. Intrinsics have Gaussian priors; and because the residuals of one image share such causes, an image
counts as a few independent observations, not as the hundreds it has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..geometry.arrays import Float, Int
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3, rotation_exp
from ..records import Features
from .local_sfm import SparseModel

PARAMETERS = ("log_focal", "log_aspect", "k1", "k2", "p1", "p2")
EFFECTIVE_OBSERVATIONS = 10.0  # independent observations that one image is worth
STUDENT = 4.0
HUBER = 1.5  # in standard deviations of a pixel coordinate
SCALE_ROUNDS = 2  # how often the pixel noise is estimated anew
MAX_ITERATIONS = 30
CONVERGED = 1e-5  # relative decrease of the cost that ends a round
DAMPING_RANGE = (1e-9, 1e9)


@dataclass(frozen=True)
class IntrinsicsPrior:
    """What is known of a camera before its images: mean and standard deviations.

    The distortions' deviations are displacements at the image corner, as a fraction of its distance from the
    centre, so that they mean the same for a wide and a narrow lens.
    """

    camera: Camera  # the mean, working size; its principal point is kept
    focal_sigma: float  # relative
    aspect_sigma: float = 0.003  # of log(fx / fy)
    radial_sigma: float = 0.005
    wave_sigma: float = 0.03
    tangential_sigma: float = 0.001

    def mean(self) -> Float:
        """Return the mean (6,) of `PARAMETERS`."""
        return _parameters(self.camera)

    def whitening(self) -> Float:
        """Return the matrix (6, 6) that turns a deviation of `PARAMETERS` into standard deviations."""
        camera = self.camera
        corner = float(np.hypot(camera.width / camera.fx, camera.height / camera.fy)) / 2.0
        matrix = np.diag(
            1.0
            / np.array(
                [
                    self.focal_sigma,
                    self.aspect_sigma,
                    self.radial_sigma,
                    self.wave_sigma,
                    self.tangential_sigma,
                    self.tangential_sigma,
                ]
            )
        )
        matrix[2, 2:4] = np.array([corner**2, corner**4]) / self.radial_sigma
        matrix[3, 3] *= corner**4
        matrix[4:, 4:] *= corner
        return matrix


@dataclass(frozen=True)
class SelfCalibration:
    """The adjusted model, and per free camera key how well its intrinsics are known."""

    model: SparseModel
    sigma: Mapping[str, Float]  # (6,) posterior standard deviation of PARAMETERS
    shift: Mapping[str, Float]  # (6,) estimate minus prior mean, in prior standard deviations
    notes: Mapping[str, float]  # pixel noise, iterations, mean reprojection error before and after


def self_calibrate(
    model: SparseModel,
    features: Mapping[int, Features],
    keys: Mapping[int, str],
    priors: Mapping[str, IntrinsicsPrior],
    held: frozenset[str] = frozenset(),
) -> SelfCalibration:
    """Adjust poses, points and the intrinsics of the camera keys outside `held`; the frame stays about the same.

    `priors` holds every key that is free; held keys keep the camera of the model. Huber weights, Levenberg-Marquardt
    with the points eliminated (Triggs et al. 2000, Bundle Adjustment - A Modern Synthesis).
    """
    problem = _Problem.of(model, features, keys, priors, held)
    state = problem.start(model)
    iterations = 0
    before = np.linalg.norm(problem.residuals(state), axis=1)
    for _ in range(SCALE_ROUNDS):
        noise_px = problem.noise_px(state)
        state, used = _minimise(problem, state, noise_px)
        iterations += used
    covariance = problem.intrinsics_covariance(state, noise_px)
    errors = np.linalg.norm(problem.residuals(state), axis=1)
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, len(PARAMETERS))
    notes = {
        "pixel_noise_px": noise_px,
        "iterations": float(iterations),
        "reprojection_before_px": float(before.mean()),
        "reprojection_after_px": float(errors.mean()),
    }
    return SelfCalibration(
        model=problem.to_model(model, state, errors),
        sigma=dict(zip(problem.free, sigma, strict=True)),
        shift={
            key: priors[key].whitening() @ (values - priors[key].mean())
            for key, values in zip(problem.free, state.intrinsics, strict=True)
        },
        notes=notes,
    )


@dataclass(frozen=True)
class _State:
    """The unknowns."""

    rotations: Float  # (I, 3, 3) local_from_cam
    centres: Float  # (I, 3) local frame
    points: Float  # (N, 3) local frame
    intrinsics: Float  # (K, 6) PARAMETERS of the free keys


@dataclass(frozen=True)
class _Normal:
    """The normal equations in blocks: poses and intrinsics (C) against points (P), one block per observation."""

    cc: Float  # (D, D)
    pp: Float  # (N, 3, 3)
    pose_point: Float  # (M, 6, 3)
    intrinsics_point: Float  # (K, N, 6, 3)
    c: Float  # (D,) negative gradient
    p: Float  # (N, 3)
    image: Int  # (M,)
    point: Int  # (M,)

    def eliminated(self, damping: float) -> tuple[Float, Float, Float]:
        """Return the root of pp^-1 (N, 3, 3), cp times it (D, 3N), and the damped system of C alone (D, D)."""
        diagonal = np.einsum("nii->ni", self.pp)
        damped = self.pp + ((damping + DAMPING_RANGE[0]) * diagonal)[:, :, None] * np.eye(3)
        root = np.swapaxes(np.linalg.inv(np.linalg.cholesky(damped)), 1, 2)
        cp = np.zeros((len(self.c), len(self.pp), 3))
        cp[6 * self.image[:, None] + np.arange(6), self.point[:, None]] = self.pose_point @ root[self.point]
        for row, block in enumerate(self.intrinsics_point[::-1], start=1):
            first = len(self.c) - row * len(PARAMETERS)
            cp[first : first + len(PARAMETERS)] = np.swapaxes(block @ root, 0, 1)
        cp = cp.reshape(len(self.c), -1)
        cc = self.cc + np.diag((damping + DAMPING_RANGE[0]) * np.diag(self.cc))
        return root, cp, cc - cp @ cp.T

    def step(self, damping: float) -> tuple[Float, Float]:
        """Return the damped Newton step of poses and intrinsics (D,) and of the points (N, 3)."""
        root, cp, matrix = self.eliminated(damping)
        p = np.einsum("nji,nj->ni", root, self.p).ravel()
        scale = 1.0 / np.sqrt(np.diag(self.cc))
        dc = scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * (self.c - cp @ p))
        dp = np.einsum("nij,nj->ni", root, (p - cp.T @ dc).reshape(-1, 3))
        return dc, dp


@dataclass(frozen=True)
class _Problem:
    """Observations sorted by point, and the priors."""

    images: tuple[int, ...]  # shot index by image row
    image: Int  # (M,) image row
    point: Int  # (M,) ascending: row among the points
    pixel: Float  # (M, 2)
    deflation: Float  # (M,) weight from the effective number of observations
    keys: tuple[str, ...]  # camera key by image row
    free: tuple[str, ...]  # camera keys that are estimated
    cameras: Mapping[str, Camera]  # by key: what is held, and the principal points
    mean: Float  # (K, 6)
    whitening: Float  # (K, 6, 6)

    @classmethod
    def of(
        cls,
        model: SparseModel,
        features: Mapping[int, Features],
        keys: Mapping[int, str],
        priors: Mapping[str, IntrinsicsPrior],
        held: frozenset[str],
    ) -> _Problem:
        images = tuple(sorted(model.local_from_cam))
        tracks = [model.tracks[i] for i in images]
        counts = np.array([len(track.points) for track in tracks])
        point = np.concatenate([track.points for track in tracks])
        pixel = np.concatenate([features[i].pixels[model.tracks[i].features] for i in images]).astype(float)
        image = np.repeat(np.arange(len(images)), counts)
        # Sorted by point; an image that holds two features of one point counts with the first of them.
        order = np.unique(point * len(images) + image, return_index=True)[1]
        used = tuple(keys[i] for i in images)
        free = tuple(sorted(set(used) - held))
        return cls(
            images=images,
            image=image[order],
            point=point[order],
            pixel=pixel[order],
            deflation=np.minimum(1.0, EFFECTIVE_OBSERVATIONS / np.maximum(counts, 1))[image[order]],
            keys=used,
            free=free,
            cameras=dict(model.cameras),
            mean=np.array([priors[key].mean() for key in free]).reshape(-1, len(PARAMETERS)),
            whitening=np.array([priors[key].whitening() for key in free]).reshape(-1, len(PARAMETERS), len(PARAMETERS)),
        )

    def start(self, model: SparseModel) -> _State:
        poses = [model.local_from_cam[i] for i in self.images]
        return _State(
            rotations=np.array([pose.rotation for pose in poses]),
            centres=np.array([pose.translation for pose in poses]),
            points=np.asarray(model.points, float),
            intrinsics=np.array([_parameters(model.cameras[key]) for key in self.free]).reshape(-1, len(PARAMETERS)),
        )

    def camera(self, key: str, state: _State) -> Camera:
        if key not in self.free:
            return self.cameras[key]
        return _with_parameters(self.cameras[key], state.intrinsics[self.free.index(key)])

    def in_camera(self, state: _State) -> Float:
        """Return the observed points (M, 3) in the frames of their cameras."""
        offset = state.points[self.point] - state.centres[self.image]
        return np.einsum("mji,mj->mi", state.rotations[self.image], offset)

    def per_key(self, state: _State) -> list[tuple[str, Camera, Int]]:
        """Return each camera key with its camera and its rows among the observations."""
        key_of_row = np.array(self.keys)[self.image]
        return [(key, self.camera(key, state), np.flatnonzero(key_of_row == key)) for key in sorted(set(self.keys))]

    def residuals(self, state: _State) -> Float:
        """Return observed minus projected pixels (M, 2); NaN behind a camera."""
        seen = self.in_camera(state)
        projected = np.empty_like(self.pixel)
        for _, camera, rows in self.per_key(state):
            projected[rows] = camera.project(seen[rows])
        return self.pixel - projected

    def noise_px(self, state: _State) -> float:
        """Return the standard deviation of a pixel coordinate from the median residual."""
        squared = np.sum(self.residuals(state) ** 2, axis=1)
        unknowns = 3 * len(state.points) + 6 * len(self.images)
        redundancy = max(1.0 - unknowns / (2.0 * len(squared)), 0.05)
        return float(np.sqrt(np.nanmedian(squared) / (2.0 * np.log(2.0)) / redundancy))  # Rayleigh's median

    def cost(self, state: _State, noise_px: float) -> float:
        """Return half the deflated Huber cost plus the priors'; infinite with a point behind its camera."""
        ratio = np.linalg.norm(self.residuals(state), axis=1) / noise_px
        if not np.isfinite(ratio).all():
            return np.inf
        huber = np.where(ratio <= HUBER, 0.5 * ratio**2, HUBER * (ratio - 0.5 * HUBER))
        deviation = self.deviation(state)
        return float(self.deflation @ huber + 0.5 * STUDENT * np.sum(np.log1p(deviation**2 / STUDENT)))

    def deviation(self, state: _State) -> Float:
        """Return the intrinsics (K, 6) minus the prior mean in standard deviations."""
        return np.einsum("kij,kj->ki", self.whitening, state.intrinsics - self.mean)

    def normal_equations(self, state: _State, noise_px: float) -> _Normal:
        """Return the normal equations of the reweighted residuals and the priors."""
        residual = self.residuals(state)
        ratio = np.linalg.norm(residual, axis=1) / noise_px
        root = np.sqrt(self.deflation * np.minimum(1.0, HUBER / np.maximum(ratio, 1e-12))) / noise_px
        residual = root[:, None] * residual
        by_pose, by_intrinsics, by_point = (root[:, None, None] * jacobian for jacobian in self.jacobians(state))
        n, first = len(PARAMETERS), 6 * len(self.images)
        cc, c = np.zeros((first + self.mean.size,) * 2), np.zeros(first + self.mean.size)
        for image, key in enumerate(self.keys):
            rows = np.flatnonzero(self.image == image)
            columns, parts = [np.arange(6 * image, 6 * image + 6)], [by_pose[rows]]
            if key in self.free:
                columns.append(first + n * self.free.index(key) + np.arange(n))
                parts.append(by_intrinsics[rows])
            jacobian, column = np.concatenate(parts, axis=2).reshape(2 * len(rows), -1), np.concatenate(columns)
            cc[np.ix_(column, column)] += jacobian.T @ jacobian
            c[column] += jacobian.T @ residual[rows].ravel()
        deviation = self.deviation(state)
        for k, whitening in enumerate(self.whitening):
            weighted = whitening.T / (1.0 + deviation[k] ** 2 / STUDENT)
            block = slice(first + n * k, first + n * (k + 1))
            cc[block, block] += weighted @ whitening
            c[block] -= weighted @ deviation[k]
        starts = np.flatnonzero(np.diff(self.point, prepend=-1))
        point_t = np.swapaxes(by_point, 1, 2)
        key_of_row = np.array(self.keys)[self.image]
        blocks = [
            np.add.reduceat(np.swapaxes(by_intrinsics * (key_of_row == key)[:, None, None], 1, 2) @ by_point, starts)
            for key in self.free
        ]
        return _Normal(
            cc=cc,
            pp=np.add.reduceat(point_t @ by_point, starts),
            pose_point=np.swapaxes(by_pose, 1, 2) @ by_point,
            intrinsics_point=np.array(blocks).reshape(-1, len(starts), n, 3),
            c=c,
            p=np.add.reduceat((point_t @ residual[:, :, None])[:, :, 0], starts),
            image=self.image,
            point=self.point,
        )

    def jacobians(self, state: _State) -> tuple[Float, Float, Float]:
        """Return d projected / d (rotation, centre) (M, 2, 6), intrinsics (M, 2, 6), point (M, 2, 3)."""
        seen = self.in_camera(state)
        m = len(seen)
        by_seen, by_intrinsics = np.empty((m, 2, 3)), np.zeros((m, 2, len(PARAMETERS)))
        for key, camera, rows in self.per_key(state):
            by_seen[rows], derivative = projection_jacobians(camera, seen[rows])
            if key in self.free:
                by_intrinsics[rows] = derivative
        by_point = by_seen @ np.swapaxes(state.rotations, 1, 2)[self.image]
        # The rotation is perturbed on the camera's side: R exp(w), so that the point moves by seen x w.
        by_rotation = np.cross(by_seen, seen[:, None, :])
        return np.concatenate([by_rotation, -by_point], axis=2), by_intrinsics, by_point

    def moved(self, state: _State, dc: Float, dp: Float) -> _State:
        """Return the state after a step."""
        poses = dc[: 6 * len(self.images)].reshape(-1, 6)
        turned = np.array([r @ rotation_exp(w) for r, w in zip(state.rotations, poses[:, :3], strict=True)])
        intrinsics = state.intrinsics + dc[6 * len(self.images) :].reshape(state.intrinsics.shape)
        return _State(turned, state.centres + poses[:, 3:], state.points + dp, intrinsics)

    def intrinsics_covariance(self, state: _State, noise_px: float) -> Float:
        """Return the posterior covariance of the free intrinsics."""
        normal = self.normal_equations(state, noise_px)
        matrix = normal.eliminated(0.0)[2]
        scale = 1.0 / np.sqrt(np.diag(normal.cc))
        covariance = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
        first = 6 * len(self.images)
        return np.asarray(covariance[first:, first:])

    def to_model(self, model: SparseModel, state: _State, errors: Float) -> SparseModel:
        """Return the model with the state's poses, points, cameras and errors."""
        count = np.maximum(np.bincount(self.point, minlength=len(state.points)), 1)
        poses = zip(self.images, state.rotations, state.centres, strict=True)
        return replace(
            model,
            local_from_cam={i: Rigid3(rotation, centre) for i, rotation, centre in poses},
            cameras={key: self.camera(key, state) for key in model.cameras},
            points=state.points,
            reprojection_px=np.bincount(self.point, errors, minlength=len(state.points)) / count,
            mean_reprojection_px=float(errors.mean()),
        )


def projection_jacobians(camera: Camera, seen: Float) -> tuple[Float, Float]:
    """Return d pixel / d point (M, 2, 3) and d pixel / d PARAMETERS (M, 2, 6) of points (M, 3) in the camera frame."""
    k1, k2, p1, p2 = camera.distortion
    x, y, z = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2], seen[:, 2]
    r2 = x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y  # d xd / d y = d yd / d x
    yy = radial + slope * y * y + 2.0 * p2 * x + 6.0 * p1 * y
    by_seen = np.stack(
        [
            camera.fx * np.stack([xx, xy, -(x * xx + y * xy)], axis=1),
            camera.fy * np.stack([xy, yy, -(x * xy + y * yy)], axis=1),
        ],
        axis=1,
    )
    by_seen /= z[:, None, None]
    u = np.stack([xd, 0.5 * xd, x * r2, x * r2**2, 2.0 * x * y, r2 + 2.0 * x * x], axis=1)
    v = np.stack([yd, -0.5 * yd, y * r2, y * r2**2, r2 + 2.0 * y * y, 2.0 * x * y], axis=1)
    return by_seen, np.stack([camera.fx * u, camera.fy * v], axis=1)


def _minimise(problem: _Problem, state: _State, noise_px: float) -> tuple[_State, int]:
    cost, damping = problem.cost(state, noise_px), 1e-6
    for iteration in range(1, MAX_ITERATIONS + 1):
        normal = problem.normal_equations(state, noise_px)
        while True:
            trial = problem.moved(state, *normal.step(damping))
            trial_cost = problem.cost(trial, noise_px)
            if trial_cost <= cost or damping > DAMPING_RANGE[1]:
                break
            damping *= 10.0
        if not trial_cost <= cost:
            return state, iteration
        decrease = cost - trial_cost
        state, cost, damping = trial, trial_cost, max(damping / 10.0, DAMPING_RANGE[0])
        if decrease <= CONVERGED * cost:
            break
    return state, iteration


def _parameters(camera: Camera) -> Float:
    return np.array([0.5 * np.log(camera.fx * camera.fy), np.log(camera.fx / camera.fy), *camera.distortion])


def _with_parameters(camera: Camera, parameters: Float) -> Camera:
    focal, aspect = np.exp(parameters[0]), np.exp(0.5 * parameters[1])
    k1, k2, p1, p2 = (float(p) for p in parameters[2:])
    return replace(camera, fx=float(focal * aspect), fy=float(focal / aspect), distortion=(k1, k2, p1, p2))
