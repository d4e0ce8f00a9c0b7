"""What a result lacks is told first, and by far too little or too far off is no success."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from onthefly3r.errors import IncompleteError, MisfitError
from onthefly3r.geometry.transforms import Sim3
from onthefly3r.records import GeoReference, GpsFix, Shot
from onthefly3r.run.verdict import misfits, raise_for, shortfall

SHOT = Shot("a.jpg", Path("a.jpg"), 4000, 3000, "camera", 0.7, 0.02, "guess", gps=GpsFix(48.0, 15.0, 300.0))


def reference(rmse_h_m: float, count: int = 5) -> GeoReference:
    residuals = dict.fromkeys(range(count), (rmse_h_m, 0.0, 0.0))
    return GeoReference(
        Sim3(), 48.0, 15.0, 300.0, "EPSG:32633", "ellipsoidal", "test", count, 0, rmse_h_m, 0.1, residuals
    )


def stated(sigma_h_m: float | None) -> dict[int, Shot]:
    assert SHOT.gps is not None
    return {i: replace(SHOT, gps=replace(SHOT.gps, sigma_h_m=sigma_h_m)) for i in range(5)}


@pytest.mark.parametrize(("placed", "told"), [(100, False), (90, False), (89, True), (0, True)])
def test_missing_photographs_are_told_from_a_tenth_on(placed: int, told: bool) -> None:
    said = shortfall(placed, 100)
    assert bool(said) == told
    assert not told or said[0].startswith(f"{100 - placed} of 100 photographs are not placed")


def test_fewer_than_half_is_incomplete_unless_that_is_allowed() -> None:
    raise_for(50, 100, [], False, allow_partial=False)
    raise_for(49, 100, [], False, allow_partial=True)
    with pytest.raises(IncompleteError, match="51 of 100 photographs are not placed") as raised:
        raise_for(49, 100, [], False, allow_partial=False)
    assert raised.value.exit_code == 5


@pytest.mark.parametrize(("error_px", "told", "is_far"), [(2.0, 0, False), (8.0, 1, False), (15.0, 1, True)])
def test_photographs_that_fit_no_rigid_scene(error_px: float, told: int, is_far: bool) -> None:
    said, far = misfits({"reprojection_after_px": error_px}, {0: SHOT}, None)
    assert (len(said), far) == (told, is_far)
    assert not said or "rolling shutter" in said[0]


@pytest.mark.parametrize(
    ("rmse_h_m", "sigma_h_m", "told", "is_far"),
    [(0.1, 0.03, 0, False), (2.0, 0.3, 1, False), (9.0, 0.3, 1, True), (15.0, None, 0, False)],
)
def test_positions_against_what_they_are_said_to_be_good_for(
    rmse_h_m: float, sigma_h_m: float | None, told: int, is_far: bool
) -> None:
    """Consumer receivers state nothing: their scatter is no misfit."""
    said, far = misfits({}, stated(sigma_h_m), reference(rmse_h_m))
    assert (len(said), far) == (told, is_far)


def test_a_result_that_is_far_off_is_no_success_even_if_parts_are_allowed() -> None:
    with pytest.raises(MisfitError, match="should not be used") as raised:
        raise_for(100, 100, ["the map misses the positions"], True, allow_partial=True)
    assert raised.value.exit_code == 3
