from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from onthefly3r.geometry.transforms import Rigid3, Sim3, rotation_exp
from onthefly3r.options import RegistrationOptions
from onthefly3r.records import Alignment, LocalModel
from onthefly3r.registration.validate import (
    ReferenceVerdict,
    pose_residuals,
    reference_points_in_map,
    validate_query,
    validate_references,
)
from synthetic_models import (
    HEIGHT_M,
    MAP_FROM_LOCAL,
    local_model,
    misplaced,
    moved,
    true_references,
    true_view,
    world_from_cam,
)

REFERENCES = (0, 1, 2, 5, 6)
SPACING_M = 2.1  # ground distance of neighbouring pixels: tau_t is 105 m
POSES = {i: world_from_cam(i) for i in range(10)}


def alignment_of(map_from_local: Sim3 = MAP_FROM_LOCAL, references: tuple[int, ...] = REFERENCES) -> Alignment:
    return Alignment(map_from_local, np.eye(7), 1.0, 0.1, 100, references)


def verdict_on(
    model: LocalModel,
    alignment: Alignment | None = None,
    spacing: float = SPACING_M,
    poses: Mapping[int, Rigid3] = POSES,
    **options: float,
) -> ReferenceVerdict:
    chosen = replace(RegistrationOptions(), **options)  # type: ignore[arg-type]
    return validate_references(model, alignment or alignment_of(), poses, spacing, chosen)


def test_residuals_are_shift_and_angle_of_the_reference_cameras() -> None:
    model = local_model(REFERENCES, bad={5: misplaced(5, 7.0, 12.0)})
    residuals = {r.index: r for r in pose_residuals(model, MAP_FROM_LOCAL, POSES, REFERENCES)}
    assert residuals[5].translation == pytest.approx(12.0, abs=1e-6)
    assert residuals[5].rotation_deg == pytest.approx(7.0, abs=1e-6)
    assert residuals[0].translation == pytest.approx(0.0, abs=1e-6)
    assert residuals[0].rotation_deg == pytest.approx(0.0, abs=1e-6)


def test_a_good_model_passes() -> None:
    verdict = verdict_on(local_model(REFERENCES))
    assert verdict.passed and verdict.reason == ""
    assert verdict.scale_ratio == pytest.approx(1.0, abs=1e-6)
    assert len(verdict.residuals) == 5


def test_too_few_references() -> None:
    verdict = verdict_on(local_model(REFERENCES), alignment_of(references=(0, 1)))
    assert verdict.reason == "only 2 of 3 references"


def test_shift_gate_follows_the_scene_spacing() -> None:
    """Eq. 13: alpha * l_scene; all five shifted alike, so that only the absolute gate can see it."""
    lifted = replace(MAP_FROM_LOCAL, translation=MAP_FROM_LOCAL.translation + np.array([0.0, 0.0, 20.0]))
    model = local_model(REFERENCES)
    assert verdict_on(model, alignment_of(lifted), spacing=0.41).passed  # 20.5 m allowed
    assert verdict_on(model, alignment_of(lifted), spacing=0.39).reason == "5 references are shifted"
    assert verdict_on(model, alignment_of(lifted), spacing=0.39, alpha=60.0).passed


def test_rotation_gate() -> None:
    model = local_model(REFERENCES, bad={5: misplaced(5, 11.0, 0.0)})
    assert verdict_on(model).reason == "1 references are rotated"
    assert verdict_on(model, max_rotation_deg=12.0).passed


@pytest.mark.parametrize("factor", [2.2, 1 / 2.2])
def test_scale_gate_is_symmetric(factor: float) -> None:
    """The scale that the points found against the distances of the reference cameras."""
    wrong = replace(MAP_FROM_LOCAL, scale=MAP_FROM_LOCAL.scale * factor)
    verdict = verdict_on(local_model(REFERENCES), alignment_of(wrong))
    assert verdict.reason == "implausible scale"
    assert verdict.scale_ratio == pytest.approx(factor)
    assert verdict_on(local_model(REFERENCES), alignment_of(wrong), max_scale_ratio=2.3, spacing=1e6).passed


def test_a_reference_apart_from_a_tight_group_is_seen_below_the_absolute_gate() -> None:
    """30 m of shift is less than tau_t = 105 m, but the four others agree within centimetres."""
    model = local_model(REFERENCES, bad={5: misplaced(5, 0.0, 30.0)})
    assert verdict_on(model).reason == "1 references disagree with the others"
    # A little less tight than the group is no reason: the floor is a tenth of tau_t.
    assert verdict_on(local_model(REFERENCES, bad={5: misplaced(5, 0.0, 9.0)})).passed


def test_scale_is_not_judged_where_reference_cameras_coincide() -> None:
    same = {i: replace(POSES[i], translation=np.zeros(3)) for i in REFERENCES}
    assert verdict_on(local_model(REFERENCES), poses=same, spacing=1e6).scale_ratio == 1.0


def map_points() -> np.ndarray:
    return reference_points_in_map(true_references(REFERENCES), {i: Sim3() for i in REFERENCES})


def test_a_query_that_agrees_with_the_map_passes() -> None:
    model = local_model([7])
    verdict = validate_query(7, model.views[7], MAP_FROM_LOCAL.inverse(), map_points(), 0.5)
    assert verdict.passed
    assert verdict.overlap > 200
    assert verdict.agreeing > 0.99
    assert abs(verdict.depth_bias) < 0.002


@pytest.mark.parametrize("seed", range(5))
def test_a_misplaced_query_is_refused(seed: int) -> None:
    """30 degrees and 40 m off, as in the oracle's faults."""
    model = local_model([7], bad={7: misplaced(7, 30.0, 40.0, seed)})
    verdict = validate_query(7, model.views[7], MAP_FROM_LOCAL.inverse(), map_points(), 0.5)
    assert not verdict.passed, verdict


def test_depth_that_is_a_tenth_too_short_is_refused_with_its_bias() -> None:
    view = true_view(7)
    camera_at = world_from_cam(7).translation
    shrunk = replace(view, points=(camera_at + 0.9 * (view.points - camera_at)).astype(np.float32))
    verdict = validate_query(7, shrunk, Sim3(), map_points(), 0.5)
    assert verdict.reason == "its depth disagrees with the map"
    assert verdict.depth_bias == pytest.approx(-np.log(0.9), abs=0.005)


def test_a_query_elsewhere_does_not_overlap() -> None:
    far = moved(true_view(7), Sim3(1.0, np.eye(3), np.array([5.0 * HEIGHT_M, 0.0, 0.0])))
    verdict = validate_query(7, far, Sim3(), map_points(), 0.5)
    assert (verdict.overlap, verdict.reason) == (0, "does not overlap the references")
    upside_down = moved(true_view(7), Sim3(1.0, rotation_exp(np.array([np.pi, 0.0, 0.0])), np.array([0.0, 0.0, 200.0])))
    assert not validate_query(7, upside_down, Sim3(), map_points(), 0.5).passed


def test_pixels_without_trust_do_not_count() -> None:
    blind = replace(true_view(7), confidence=np.full((42, 56), 0.4, np.float32))
    assert validate_query(7, blind, Sim3(), map_points(), 0.5).overlap == 0


def test_no_references_give_no_points() -> None:
    assert reference_points_in_map({}, {}).shape == (0, 3)
