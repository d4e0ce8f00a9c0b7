"""Bundle adjustment: its derivatives, what it recovers, and what it says of its own precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.adjust.bundle import Bundle, State
from onthefly3r.adjust.intrinsics import PARAMETERS, intrinsics_of, projection_jacobians, with_intrinsics
from onthefly3r.adjust.selfcal import IntrinsicsPrior
from onthefly3r.geometry.umeyama import weighted_similarity


def bundle_of(truth: synthetic.Block, free: bool = True, prior: IntrinsicsPrior | None = None) -> Bundle:
    images = sorted(truth.poses)
    image = np.concatenate([np.full(len(truth.seen[i]), i) for i in images])
    point = np.concatenate([truth.seen[i] for i in images])
    pixel = np.concatenate([truth.features[i].pixels for i in images]).astype(float)
    order = np.argsort(point, kind="stable")
    prior = prior or IntrinsicsPrior(truth.camera, 0.05)
    keys = (synthetic.KEY,) if free else ()
    return Bundle(
        image=image[order],
        point=point[order],
        pixel=pixel[order],
        weight=np.ones(len(point)),
        keys=(synthetic.KEY,) * len(images),
        free=keys,
        cameras={synthetic.KEY: truth.camera},
        mean=np.array([prior.mean() for _ in keys]).reshape(-1, 8),
        whitening=np.array([prior.whitening() for _ in keys]).reshape(-1, 8, 8),
        adjustable=np.ones(8, bool),
    )


def state_of(truth: synthetic.Block, turn_deg: float = 0.0, shift: float = 0.0, free: bool = True) -> State:
    model = synthetic.sparse_model(truth, turn_deg=turn_deg, shift=shift)
    images = sorted(model.local_from_cam)
    return State(
        np.array([model.local_from_cam[i].rotation for i in images]),
        np.array([model.local_from_cam[i].translation for i in images]),
        model.points,
        np.array([intrinsics_of(truth.camera)] if free else []).reshape(-1, 8),
    )


@pytest.fixture(scope="module")
def truth() -> synthetic.Block:
    return synthetic.block(noise_px=0.3)


def camera_error(truth: synthetic.Block, state: State) -> float:
    """RMS distance of the camera centres after a similarity, the gauge being free."""
    centres = np.array([truth.poses[i].translation for i in sorted(truth.poses)])
    fit = weighted_similarity(state.centres, centres, np.ones(len(centres)))
    return float(np.sqrt(np.sum((fit.apply(state.centres) - centres) ** 2, axis=1).mean()))


def test_intrinsics_survive_the_round_trip() -> None:
    camera = replace(synthetic.CAMERA, fx=790.0)
    again = with_intrinsics(camera, intrinsics_of(camera))
    assert np.allclose(
        (again.fx, again.cx, again.cy, *again.distortion), (camera.fx, camera.cx, camera.cy, *camera.distortion)
    )


def test_projection_derivatives_are_those_of_the_projection() -> None:
    rng = np.random.default_rng(0)
    seen = np.column_stack([rng.uniform(-20, 20, (40, 2)), rng.uniform(40, 60, 40)])
    by_seen, by_parameters = projection_jacobians(synthetic.CAMERA, seen)
    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        numeric = (synthetic.CAMERA.project(seen + step) - synthetic.CAMERA.project(seen - step)) / 2e-4
        assert np.allclose(by_seen[:, :, k], numeric, atol=1e-5)
    parameters = intrinsics_of(synthetic.CAMERA)
    for k in range(len(PARAMETERS)):
        step = 1e-6 * np.eye(8)[k]
        more, less = (with_intrinsics(synthetic.CAMERA, parameters + sign * step) for sign in (1.0, -1.0))
        numeric = (more.project(seen) - less.project(seen)) / 2e-6
        assert np.allclose(by_parameters[:, :, k], numeric, rtol=1e-5, atol=1e-3)


def test_steps_in_poses_and_points_have_the_derivatives_it_uses(truth: synthetic.Block) -> None:
    bundle, state = bundle_of(truth), state_of(truth)
    by_pose, by_intrinsics, by_point = bundle.jacobians(state)
    size = 6 * len(truth.poses) + 8
    rng = np.random.default_rng(2)
    dc, dp = 1e-5 * rng.standard_normal(size), 1e-4 * rng.standard_normal(state.points.shape)
    moved = bundle.residuals(bundle.moved(state, dc, dp)) - bundle.residuals(bundle.moved(state, -dc, -dp))
    poses = dc[:-8].reshape(-1, 6)[bundle.image]
    predicted = np.einsum("mij,mj->mi", by_pose, poses) + by_intrinsics @ dc[-8:]
    predicted += np.einsum("mij,mj->mi", by_point, dp[bundle.point])
    assert np.allclose(moved, -2.0 * predicted, atol=2e-5)


@pytest.mark.parametrize("free", [False, True])
def test_cameras_come_back_from_a_disturbed_start(truth: synthetic.Block, free: bool) -> None:
    """Noise 0.3 px at 800 px focal length and 50 m: centimetres, twice as many with the lens unknown."""
    bundle, start = bundle_of(truth, free), state_of(truth, turn_deg=0.5, shift=0.5, free=free)
    solved, _ = bundle.minimised(start, bundle.noise_px(start))
    solved, _ = bundle.minimised(solved, bundle.noise_px(solved))
    assert camera_error(truth, start) > 0.4
    assert camera_error(truth, solved) < (0.1 if free else 0.05)
    assert bundle.noise_px(solved) == pytest.approx(0.3, rel=0.1)


def test_mismatches_are_outvoted(truth: synthetic.Block) -> None:
    bundle = bundle_of(truth, free=False)
    rng = np.random.default_rng(5)
    wrong = rng.random(len(bundle.pixel)) < 0.05
    bundle = replace(bundle, pixel=bundle.pixel + wrong[:, None] * rng.normal(0.0, 30.0, bundle.pixel.shape))
    solved = state_of(truth, free=False)
    for _ in range(3):
        solved, _ = bundle.minimised(solved, bundle.noise_px(solved))
    assert camera_error(truth, solved) < 0.1


def test_stated_precision_of_the_focal_length_is_its_scatter() -> None:
    """Over twenty noises: the scatter of the estimates is the stated standard deviation, within sampling error."""
    found, stated = [], []
    for seed in range(20):
        truth = synthetic.block(rows=2, columns=3, n_points=400, noise_px=0.5, seed=3)
        rng = np.random.default_rng(100 + seed)
        bundle = bundle_of(truth, prior=IntrinsicsPrior(truth.camera, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0))
        bundle = replace(bundle, pixel=bundle.pixel + 0.5 * rng.standard_normal(bundle.pixel.shape))
        solved, _ = bundle.minimised(state_of(truth), np.sqrt(0.5))
        normal = bundle.normal_equations(solved, np.sqrt(0.5))
        found.append(solved.intrinsics[0, 0])
        stated.append(np.sqrt(normal.shared_covariance()[0, 0]))
    # The first noise is common to all seeds; half of the variance differs. A Huber kernel costs about a tenth.
    assert np.std(found) * np.sqrt(2.0) == pytest.approx(np.mean(stated), rel=0.5)


def test_a_point_behind_its_camera_costs_infinitely_much(truth: synthetic.Block) -> None:
    bundle, state = bundle_of(truth, free=False), state_of(truth, free=False)
    points = state.points.copy()
    points[bundle.point[0], 2] = 200.0
    assert bundle.cost(replace(state, points=points), 1.0) == np.inf
