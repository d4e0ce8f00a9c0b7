"""Standard deviations are honest: errors over many made-up surveys are as large as each of them states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import synthetic_block as synthetic
from onthefly3r.adjust import deviations
from onthefly3r.adjust.bundle import Bundle, State
from onthefly3r.adjust.deviations import camera_deviations
from onthefly3r.adjust.ties import Ties
from test_adjust_bundle import bundle_of, state_of

SURVEYS = 50
POSITION_M = np.array([1.5, 1.5, 3.0])
NOISE_PX = 0.5


def tied(truth: synthetic.Block, rng: np.random.Generator) -> tuple[Bundle, State]:
    """A block with noisy observations, and with noisy positions and two control points."""
    bundle, state = bundle_of(truth, free=False), state_of(truth, free=False)
    n = len(bundle.keys)
    control = np.array([3, 40])
    ties = Ties(
        position=state.centres + rng.normal(0.0, 1.0, (n, 3)) * POSITION_M,
        sigma=np.tile(POSITION_M, (n, 1)),
        flight=np.zeros(n, int),
        bias_sigma=np.zeros(6),
        up=np.tile([0.0, 0.0, 1.0], (n, 1)),
        level_root=np.zeros((n, 2, 2)),
        control=control,
        control_m=state.points[control] + rng.normal(0.0, 0.02, (2, 3)),
        control_sigma_m=np.full((2, 3), 0.02),
    )
    pixel = bundle.pixel + NOISE_PX * rng.standard_normal(bundle.pixel.shape)
    return replace(bundle, ties=ties, pixel=pixel), replace(state, biases=np.zeros(6))


@pytest.fixture(scope="module")
def truth() -> synthetic.Block:
    block = synthetic.block(rows=2, columns=3, n_points=150)
    often = np.bincount(np.concatenate(list(block.seen.values())), minlength=len(block.points)) >= 2
    kept = np.cumsum(often) - 1
    features = {i: replace(f, pixels=f.pixels[often[block.seen[i]]]) for i, f in block.features.items()}
    seen = {i: kept[s[often[s]]] for i, s in block.seen.items()}
    return replace(block, points=block.points[often], features=features, seen=seen)


def test_errors_of_cameras_are_as_large_as_stated(truth: synthetic.Block) -> None:
    ratios = []
    for survey in range(SURVEYS):
        bundle, start = tied(truth, np.random.default_rng(survey))
        found, _ = bundle.minimised(start, NOISE_PX)
        sigma = camera_deviations(bundle.normal_equations(found, NOISE_PX))[:, 3:]
        ratios.append((found.centres - start.centres) / sigma)
    spread = np.sqrt(np.mean(np.square(ratios), axis=(0, 1)))
    assert ((spread > 0.8) & (spread < 1.25)).all(), spread


def test_sampled_deviations_are_those_of_the_whole_covariance(
    truth: synthetic.Block, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle, state = tied(truth, np.random.default_rng(0))
    normal = bundle.normal_equations(state, NOISE_PX)
    exact = camera_deviations(normal)
    monkeypatch.setattr(deviations, "EXACT_UNKNOWNS", 0)
    monkeypatch.setattr(deviations, "SAMPLES", 1000)
    assert np.abs(camera_deviations(normal) / exact - 1.0).max() < 0.12
