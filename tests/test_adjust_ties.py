"""Ties of a block to what is known on the ground: their derivatives, and that wrong ones do not bend it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from onthefly3r.adjust.ties import Ties
from onthefly3r.geometry.transforms import rotation_exp


def some_ties(rng: np.random.Generator) -> Ties:
    n = 6
    sigma = np.tile([0.5, 0.5, 0.8], (n, 1))
    sigma[2] = np.inf
    up = rng.standard_normal((n, 3)) * 0.1 + (0.0, 0.0, 1.0)
    return Ties(
        position=rng.normal(0.0, 0.3, (n, 3)),
        sigma=sigma,
        flight=np.array([0, 0, 0, 1, 1, 1]),
        bias_sigma=np.array([0.0, 0.0, 0.0, 2.0, 2.0, 5.0, 0.3, 0.3, 0.3]),
        up=up / np.linalg.norm(up, axis=1)[:, None],
        level_root=np.tile(3.0 * np.eye(2), (n, 1, 1)),
        control=np.array([1, 3]),
        control_m=rng.normal(0.0, 0.02, (2, 3)),
        control_sigma_m=np.full((2, 3), 0.02),
    )


def test_normal_equations_are_derivatives_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    ties = some_ties(rng)
    rotations = np.array([rotation_exp(0.1 * w) for w in rng.standard_normal((6, 3))])
    centres, points, biases = rng.normal(0, 0.2, (6, 3)), rng.normal(0, 0.02, (4, 3)), rng.normal(0, 0.1, 9)
    biases[:3] = 0.0
    terms = ties.cameras(rotations, centres, biases)
    for k in range(6):
        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            turned, moved = rotations.copy(), centres.copy()
            costs = []
            for sign in (1.0, -1.0):
                turned[k] = rotations[k] @ rotation_exp(sign * step)
                costs.append(ties.cost(turned, centres, points, biases))
            assert np.isclose(-terms.poses_right[k, axis], (costs[0] - costs[1]) / 2e-6, atol=1e-4)
            costs = []
            for sign in (1.0, -1.0):
                moved[k] = centres[k] + sign * step
                costs.append(ties.cost(rotations, moved, points, biases))
            assert np.isclose(-terms.poses_right[k, 3 + axis], (costs[0] - costs[1]) / 2e-6, atol=1e-4)
    for b in range(3, 9):
        step = 1e-6 * np.eye(9)[b]
        difference = ties.cost(rotations, centres, points, biases + step) - ties.cost(
            rotations, centres, points, biases - step
        )
        assert np.isclose(-terms.biases_right[b], difference / 2e-6, atol=1e-4)
    assert not terms.biases_right[:3].any() and not terms.mixed[:, :, :3].any()  # a bias without a prior is held
    _, right = ties.points(points)
    for k, row in enumerate(ties.control):
        for axis in range(3):
            costs = []
            for sign in (1.0, -1.0):
                moved = points.copy()
                moved[row, axis] += sign * 1e-7
                costs.append(ties.cost(rotations, centres, moved, biases))
            assert np.isclose(-right[k, axis], (costs[0] - costs[1]) / 2e-7, rtol=1e-4, atol=1e-3)


def test_a_camera_without_position_has_no_residual() -> None:
    ties = some_ties(np.random.default_rng(1))
    far = replace(ties, position=np.where(np.arange(6)[:, None] == 2, 1e9, ties.position))
    rotations = np.tile(np.eye(3), (6, 1, 1))
    assert not far.residuals(rotations, np.zeros((6, 3)), np.zeros(9))[2].any()
