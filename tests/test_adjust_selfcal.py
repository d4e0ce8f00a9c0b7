"""Self-calibration: the intrinsics follow the images where these can tell, and the priors where they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.adjust.selfcal import IntrinsicsPrior, SelfCalibration, effective_weight, self_calibrate
from onthefly3r.geometry.camera import Camera

GUESS = Camera(1000, 750, 840.0, 840.0, 500.0, 375.0)  # 5 % too long, no distortion


def calibrated(noise_px: float = 0.2, held: bool = False) -> SelfCalibration:
    truth = synthetic.block(rows=4, columns=6, n_points=2000, noise_px=noise_px)
    model = synthetic.sparse_model(truth, GUESS)
    keys = dict.fromkeys(truth.poses, synthetic.KEY)
    priors = {} if held else {synthetic.KEY: IntrinsicsPrior(GUESS, 0.05)}
    return self_calibrate(model, truth.features, keys, priors, frozenset([synthetic.KEY] if held else []))


@pytest.fixture(scope="module")
def result() -> SelfCalibration:
    return calibrated()


def test_lens_is_found(result: SelfCalibration) -> None:
    """The displacement at the image's corner, where an error of the lens is largest: two pixels of 625."""
    found, true = result.model.cameras[synthetic.KEY], synthetic.CAMERA
    rays = np.array([[0.6, 0.45, 1.0], [-0.6, 0.45, 1.0], [0.3, 0.0, 1.0]])
    scale = true.fx / found.fx
    before = np.abs(GUESS.project(rays) - true.project(rays)).max()
    after = np.abs(replace(found, fx=scale * found.fx, fy=scale * found.fy).project(rays) - true.project(rays)).max()
    assert before > 10.0 and after < 2.0
    assert abs(np.log(found.fx / true.fx)) < 0.02


def test_stated_uncertainty_covers_the_error(result: SelfCalibration) -> None:
    error = abs(np.log(result.model.cameras[synthetic.KEY].fx / synthetic.CAMERA.fx))
    assert error < 3.0 * result.sigma[synthetic.KEY][0] < 0.15


def test_reprojection_gets_better(result: SelfCalibration) -> None:
    assert result.notes["reprojection_after_px"] < 0.5 * result.notes["reprojection_before_px"]


def test_held_camera_stays() -> None:
    assert calibrated(held=True).model.cameras[synthetic.KEY] == GUESS


def test_noise_alone_does_not_move_the_lens_far() -> None:
    """Few images over flat ground cannot tell: the estimate stays within the prior's belief."""
    truth = synthetic.block(rows=1, columns=8, n_points=400, noise_px=1.0)
    flat = replace(truth, points=truth.points * (1.0, 1.0, 0.0))
    model = synthetic.sparse_model(flat, synthetic.CAMERA)
    keys = dict.fromkeys(truth.poses, synthetic.KEY)
    prior = IntrinsicsPrior(synthetic.CAMERA, 0.01)
    found = self_calibrate(model, truth.features, keys, {synthetic.KEY: prior})
    assert np.abs(found.shift[synthetic.KEY]).max() < 3.0


def test_prior_counts_displacements_at_the_corner() -> None:
    prior = IntrinsicsPrior(GUESS, 0.05, corner_sigma=0.01)
    corner = 0.5 * np.hypot(1000.0 / 840.0, 750.0 / 840.0)
    k1 = 0.01 / corner**2  # alone it moves the corner by one standard deviation
    deviation = prior.whitening() @ np.array([0.0, 0.0, k1, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert deviation[2] == pytest.approx(1.0)


def test_an_image_counts_as_a_few_observations() -> None:
    weights = effective_weight(np.repeat([0, 1], [4, 400]))
    assert weights[:4] == pytest.approx(1.0)
    assert weights[4:].sum() == pytest.approx(10.0)


def test_principal_point_is_held_unless_asked_for() -> None:
    """A lens that sits 8 px off the middle: held, it stays in the middle; free, it is found to a few pixels."""
    truth = synthetic.block(rows=4, columns=6, n_points=2000, noise_px=0.1)
    moved = {i: replace(f, pixels=f.pixels + np.float32([8.0, -8.0])) for i, f in truth.features.items()}
    model, keys = synthetic.sparse_model(truth), dict.fromkeys(truth.poses, synthetic.KEY)
    priors = {synthetic.KEY: IntrinsicsPrior(synthetic.CAMERA, 0.01)}
    held = self_calibrate(model, moved, keys, priors).model.cameras[synthetic.KEY]
    found = self_calibrate(model, moved, keys, priors, principal_point=True).model.cameras[synthetic.KEY]
    assert (held.cx, held.cy) == (500.0, 375.0)
    assert np.hypot(found.cx - 508.0, found.cy - 367.0) < 4.0
