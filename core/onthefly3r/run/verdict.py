"""Whether a result is what was asked for: how much of it is there, and whether it agrees with itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import IncompleteError, MisfitError, ReconstructionError
from ..records import GeoReference, Shot

COMPLETE_SHARE = 0.9  # less of the photographs placed is a warning,
LEAST_SHARE = 0.5  # and less is no success
GOOD_REPROJECTION = 1.5e-3  # of the image's longest side, median: a misfit that no sharp, still scene gives,
MAX_REPROJECTION = 3e-3  # and one that makes the result worthless
GOOD_SIGMAS = 4.0  # residuals of positions (RMS) over what they are said to be good for
MAX_SIGMAS = 10.0


def shortfall(placed: int, given: int) -> list[str]:
    """Return the first thing to say where photographs are missing from the result; empty where few are."""
    if not given or placed >= COMPLETE_SHARE * given:
        return []
    return [
        f"{given - placed} of {given} photographs are not placed; the report lists what each one lacked "
        "(more overlap, or photographs between the parts, would place them)"
    ]


def doubtful_positions(reference: GeoReference | None) -> list[str]:
    """Return what to say where so many positions disagree with the map that its place on the Earth is in doubt."""
    positions = len(reference.residuals_m) or reference.n_used if reference else 0
    if reference is None or not 3 * reference.n_outliers >= positions > 0:
        return []
    return [
        f"{reference.n_outliers} of {positions} positions disagree with the map: where it lies on the Earth is "
        "doubtful; check the positions in the tags or in the position file"
    ]


def misfits(
    details: Mapping[str, Any], shots: Mapping[int, Shot], reference: GeoReference | None
) -> tuple[list[str], bool]:
    """Return what misses, worst first, and whether by so far that the result is not to be used."""
    told: list[str] = []
    is_far = False
    error_px = details.get("reprojection_after_px")
    if isinstance(error_px, int | float) and shots:
        longest = max(max(shot.width_px, shot.height_px) for shot in shots.values())
        if error_px > GOOD_REPROJECTION * longest:
            is_far |= error_px > MAX_REPROJECTION * longest
            told.append(
                f"the photographs do not fit one rigid scene: {error_px:.1f} px median reprojection error; a rolling "
                "shutter, a moving scene or wrongly matched pictures do that"
            )
    if reference is not None and reference.residuals_m:
        sigmas = [s for i in reference.residuals_m if i in shots if (s := _sigma_h_m(shots[i])) is not None]
        if len(sigmas) >= 3:
            usual = sorted(sigmas)[len(sigmas) // 2]
            ratio = reference.rmse_h_m / max(usual, 0.02)
            if ratio > GOOD_SIGMAS and reference.rmse_h_m > 1.0:
                is_far |= ratio > MAX_SIGMAS and reference.rmse_h_m > 5.0
                told.append(
                    f"the map misses the positions by {reference.rmse_h_m:.1f} m (RMS), {ratio:.0f} times what they "
                    "are said to be good for; wrong positions, a rolling shutter or a bent map do that"
                )
    return told, is_far


def raise_for(placed: int, given: int, misfit: Sequence[str], is_far: bool, allow_partial: bool) -> None:
    """Raise `IncompleteError` or `MisfitError` when the result, which is written, is no success."""
    error: ReconstructionError | None = None
    if is_far:
        error = MisfitError(f"{misfit[0]}. The files are written, but should not be used as they are")
    elif given and placed < LEAST_SHARE * given and not allow_partial:
        error = IncompleteError(
            f"incomplete: {given - placed} of {given} photographs are not placed. The files show the {placed} that "
            "are; --allow-partial takes that for a result"
        )
    if error is not None:
        raise error


def _sigma_h_m(shot: Shot) -> float | None:
    return shot.gps.sigma_h_m if shot.gps else None
