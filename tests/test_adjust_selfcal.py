"""Self-calibration: the intrinsics follow the images where these can tell, and the priors where they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.adjust.evidence import effective_weight
from onthefly3r.adjust.selfcal import IntrinsicsPrior, SelfCalibration, self_calibrate
from onthefly3r.geometry.camera import Camera
from onthefly3r.records import Features

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


def off_centre(truth: synthetic.Block, x_px: float, y_px: float) -> dict[int, Features]:
    """The features as a lens whose principal point is off by so much would show them."""
    return {i: replace(f, pixels=f.pixels + np.float32([x_px, y_px])) for i, f in truth.features.items()}


def test_principal_point_is_found_where_the_images_tell_it() -> None:
    """A lens 20 px off the middle, strips flown to and fro, 0.3 px of noise: found to 2 px, where held it stays."""
    truth = synthetic.block(rows=4, columns=6, n_points=2000, noise_px=0.3)
    moved = off_centre(truth, 20.0, -12.0)
    model, keys = synthetic.sparse_model(truth), dict.fromkeys(truth.poses, synthetic.KEY)
    priors = {synthetic.KEY: IntrinsicsPrior(replace(synthetic.CAMERA, distortion=(0.0,) * 4), 0.05)}
    found = self_calibrate(model, moved, keys, priors)
    camera = found.model.cameras[synthetic.KEY]
    assert found.verdict[synthetic.KEY].startswith("free")
    assert np.hypot(camera.cx - 520.0, camera.cy - 363.0) < 2.0
    held = self_calibrate(model, moved, keys, priors, principal_point="held").model.cameras[synthetic.KEY]
    assert (held.cx, held.cy) == (500.0, 375.0)


def test_principal_point_of_a_single_strip_is_held() -> None:
    """One strip with one heading cannot tell the point from a tilt of all its cameras."""
    truth = synthetic.block(rows=1, columns=12, n_points=800, noise_px=0.3)
    model, keys = synthetic.sparse_model(truth), dict.fromkeys(truth.poses, synthetic.KEY)
    priors = {synthetic.KEY: IntrinsicsPrior(synthetic.CAMERA, 0.05)}
    found = self_calibrate(model, off_centre(truth, 3.0, -2.0), keys, priors)
    assert found.verdict[synthetic.KEY].startswith("held")
    assert (found.model.cameras[synthetic.KEY].cx, found.model.cameras[synthetic.KEY].cy) == (500.0, 375.0)
    free = self_calibrate(model, off_centre(truth, 3.0, -2.0), keys, priors, principal_point="free")
    assert free.model.cameras[synthetic.KEY].cx != 500.0
