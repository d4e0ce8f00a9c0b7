from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.errors import ReferenceFormatError
from onthefly3r.evaluate.poses import PoseSet, match, natural_key
from onthefly3r.evaluate.trajectory_errors import pose_errors
from onthefly3r.geometry.transforms import Sim3, rotation_exp

seeds = st.integers(0, 2**32 - 1)


def survey(rng: np.random.Generator, n: int = 24) -> PoseSet:
    """Strips at 50 m, 10 m apart along a strip, looking down within a few degrees."""
    centres = np.array([(10.0 * (k % 6), 20.0 * (k // 6), 50.0) for k in range(n)]) + rng.normal(0, 0.5, (n, 3))
    down = np.diag([1.0, -1.0, -1.0])
    rotations = np.stack([rotation_exp(rng.normal(0, 0.05, 3)) @ down for _ in range(n)])
    return PoseSet(Path("reference"), tuple(f"DJI_{k:04d}.JPG" for k in range(n)), centres, rotations)


def perturbed(poses: PoseSet, rng: np.random.Generator, sigma_m: float, sigma_deg: float) -> PoseSet:
    n = len(poses.names)
    turns = np.stack([rotation_exp(np.radians(rng.normal(0, sigma_deg, 3))) for _ in range(n)])
    return PoseSet(
        Path("estimate"), poses.names, poses.centres + rng.normal(0, sigma_m, (n, 3)), turns @ poses.rotations
    )


def random_sim3(rng: np.random.Generator) -> Sim3:
    return Sim3(float(np.exp(rng.uniform(-4, 4))), rotation_exp(rng.normal(0, 1, 3)), rng.normal(0, 100, 3))


@given(seed=seeds)
def test_errors_do_not_depend_on_the_frame_of_the_estimate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference = survey(rng)
    estimate = perturbed(reference, rng, 0.3, 0.5)
    plain = pose_errors(estimate, reference)
    moved = pose_errors(estimate.moved(random_sim3(rng)), reference)
    for name in ("ate", "are_deg", "rte_deg", "rre_deg"):
        assert getattr(moved, name) == pytest.approx(getattr(plain, name), rel=1e-5, abs=1e-7)


@given(seed=seeds)
def test_a_perfect_estimate_has_no_error(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference = survey(rng)
    errors = pose_errors(reference.moved(random_sim3(rng)), reference)
    assert errors.ate < 1e-8
    assert max(errors.are_deg, errors.rte_deg or 0.0, errors.rre_deg or 0.0) < 1e-5
    assert errors.coverage == 1.0


@given(seed=seeds, angle_deg=st.floats(0.01, 60.0))
def test_rotation_errors_of_known_size(seed: int, angle_deg: float) -> None:
    """Every second camera is turned by an angle about its own axis: half of the squared angle, every pair."""
    rng = np.random.default_rng(seed)
    reference = survey(rng)
    axis = rng.normal(size=3)
    turn = rotation_exp(np.radians(angle_deg) * axis / np.linalg.norm(axis))
    rotations = reference.rotations.copy()
    rotations[::2] = rotations[::2] @ turn
    errors = pose_errors(PoseSet(Path("e"), reference.names, reference.centres, rotations), reference)
    assert errors.ate < 1e-9
    assert errors.are_deg == pytest.approx(angle_deg / 2**0.5, rel=1e-6)
    assert errors.rre_deg == pytest.approx(angle_deg, rel=1e-6)
    # The translation is seen in the turned frame of the first camera, in every second pair: less than the turn.
    assert 0.0 < errors.rte_deg <= angle_deg + 1e-9


@given(angle_deg=st.floats(0.01, 80.0))
def test_translation_direction_error_of_known_size(angle_deg: float) -> None:
    """Cameras on a helix-free staircase: each step of the estimate is turned by the angle, the cameras are not."""
    steps = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] * 4)
    turn = rotation_exp(np.array([0.0, 0.0, np.radians(angle_deg)]))
    names = tuple("abcdefghi")
    upright = np.stack([np.eye(3)] * 9)
    reference = PoseSet(Path("r"), names, np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]), upright)
    estimate = PoseSet(Path("e"), names, reference.centres @ turn.T, upright)
    errors = pose_errors(estimate, reference)
    assert errors.rte_deg == pytest.approx(angle_deg, rel=1e-9)
    assert errors.rre_deg == pytest.approx(0.0, abs=1e-9)
    assert errors.are_deg == pytest.approx(angle_deg, rel=1e-5)  # the fit turns the cameras back with the centres


def test_ate_is_the_root_mean_square_distance_after_the_fit() -> None:
    """With no alignment the shift stays whole; a rigid fit removes it; the scale needs sim3."""
    reference = survey(np.random.default_rng(0))
    shifted = reference.moved(Sim3(1.0, np.eye(3), np.array([3.0, 4.0, 0.0])))
    assert pose_errors(shifted, reference, "none").ate == pytest.approx(5.0)
    assert pose_errors(shifted, reference, "se3").ate < 1e-9
    doubled = reference.moved(Sim3(2.0))
    assert pose_errors(doubled, reference, "se3").ate > 10.0
    assert pose_errors(doubled, reference, "sim3").ate < 1e-9
    assert pose_errors(doubled, reference).reference_from_estimate.scale == pytest.approx(0.5)


def test_errors_of_noise_are_of_its_size() -> None:
    """0.3 m and 0.5 deg per axis: ATE 0.3 sqrt(3), ARE 0.5 sqrt(3), RRE sqrt(2) more; 200 cameras, within 10 %."""
    rng = np.random.default_rng(7)
    reference = survey(rng, 200)
    errors = pose_errors(perturbed(reference, rng, 0.3, 0.5), reference)
    assert errors.ate == pytest.approx(0.3 * 3**0.5, rel=0.1)
    assert errors.are_deg == pytest.approx(0.5 * 3**0.5, rel=0.1)
    assert errors.rre_deg == pytest.approx(0.5 * 6**0.5, rel=0.1)


def test_coverage_and_common_frames() -> None:
    rng = np.random.default_rng(1)
    reference = survey(rng)
    estimate = perturbed(reference, rng, 0.1, 0.1)
    bent = estimate.centres.copy()
    bent[20:] += 15.0
    estimate = PoseSet(estimate.source, estimate.names, bent, estimate.rotations)
    other = reference.take(range(20))
    errors = pose_errors(estimate.take(range(22)), reference)
    assert (errors.n_common, errors.coverage) == (22, 22 / 24)
    common = pose_errors(estimate.take(range(22)), reference, only=[other])
    assert common.n_common == 20
    assert common.ate < 0.3 < errors.ate  # fitted anew, without the bent end


def test_consecutive_follows_the_order_of_the_estimate_not_of_the_reference() -> None:
    rng = np.random.default_rng(2)
    reference = survey(rng)
    estimate = perturbed(reference, rng, 0.2, 0.2)
    shuffled = reference.take(rng.permutation(24))
    assert pose_errors(estimate, shuffled).rte_deg == pytest.approx(pose_errors(estimate, reference).rte_deg)


def test_collinear_centres_are_refused_unless_nothing_is_aligned() -> None:
    reference = survey(np.random.default_rng(0), 6)
    line = PoseSet(Path("line"), reference.names, np.outer(np.arange(6.0), [1, 0, 0]), reference.rotations)
    with pytest.raises(ReferenceFormatError, match="one line"):
        pose_errors(line, line)
    assert pose_errors(line, line, "none").ate == 0.0


def named(*names: str) -> PoseSet:
    n = len(names)
    return PoseSet(Path("set"), names, np.zeros((n, 3)), np.stack([np.eye(3)] * n))


def test_names_match_whole_first_then_by_file_name() -> None:
    rows, others = match(named("b/x.JPG", "a/x.JPG", "c/Y.jpg"), named("a/x.JPG", "other/y.JPG", "b/x.JPG"))
    assert list(zip(rows.tolist(), others.tolist(), strict=True)) == [(0, 2), (1, 0), (2, 1)]


def test_a_file_name_that_could_be_two_images_is_refused() -> None:
    with pytest.raises(ReferenceFormatError, match=r"a/x\.jpg, b/x\.jpg"):
        match(named("x.jpg"), named("a/x.jpg", "b/x.jpg"))
    with pytest.raises(ReferenceFormatError, match="could be"):
        match(named("a/x.jpg", "b/x.jpg"), named("x.jpg"))


def test_an_image_is_matched_once() -> None:
    rows, others = match(named("x.jpg", "b/x.jpg"), named("b/x.jpg"))
    assert (rows.tolist(), others.tolist()) == ([1], [0])


def test_nothing_in_common_is_said() -> None:
    with pytest.raises(ReferenceFormatError, match="none of its 1 images"):
        match(named("x.jpg"), named("y.jpg"))


def test_natural_order() -> None:
    names = ["DJI_10.jpg", "DJI_9.jpg", "a/2.jpg", "dji_1.jpg", "10.jpg", "9.jpg"]
    assert sorted(names, key=natural_key) == ["9.jpg", "10.jpg", "a/2.jpg", "dji_1.jpg", "DJI_9.jpg", "DJI_10.jpg"]
