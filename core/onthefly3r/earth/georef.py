"""Tie the map to the Earth: the similarity from the map to local east-north-up, and the frame of the export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import GeoreferenceError, OptionError
from ..geometry.arrays import Float
from ..geometry.geodesy import (
    VERTICAL_NAMES,
    EnuFrame,
    WorldFrame,
    projected_crs,
    scale_factor,
    transformation_accuracy_m,
    utm_crs_for,
)
from ..geometry.transforms import Rigid3
from ..options import GeoreferenceOptions
from ..records import GeoReference, Shot
from .levelfit import LevelFit, fit
from .positions import Positions, usable_positions
from .updirection import UpWitness, angles_look_up, up_witnesses

MIN_POSITIONS = 3
LINE_RATIO = 0.02  # sideways over lengthwise extent of camera centres that count as one line
MAX_ROLL_SIGMA_DEG = 15.0  # what positions must tell about the level in its worst direction to do without gimbal
GIMBAL = "gimbal angles"
CONTRADICTION_DEG = 60.0  # between the up of the gimbal angles and that of ground and cameras: one is mistaken,
UNFOLLOWED_DEG = 30.0  # off the level that was found: angles that had no say
DECIDED = 0.5  # and it is the angles where the positions scatter this much less without them
MAX_SCALE_ERROR = 0.002  # of the projection where the survey lies; UTM stays below 0.001 in its zone
MOST_SCALED = 500  # positions whose distances tell the scale of a local frame,
FAR_SIGMAS = 5.0  # those that are this much longer than positions are wrong


def georeference(
    map_from_cam: Mapping[int, Rigid3],
    shots: Mapping[int, Shot],
    options: GeoreferenceOptions,
    ground_normal: Float | None = None,
    seed: int = 0,
) -> GeoReference:
    """Return the similarity that brings the map to the photographs' positions, level even where heights drift.

    Args:
        map_from_cam: poses of the placed cameras by shot index, map frame.
        shots: at least the shots of those cameras.
        options: target CRS, vertical reference and default accuracies.
        ground_normal: (3,) normal of the ground plane in the map frame, away from the ground; None if unknown.
        seed: of the random samples; the same seed gives the same result.

    Raises:
        GeoreferenceError: fewer than three usable positions, positions along one line without gimbal angles, or
            positions that have nothing to do with the map.
        OptionError: `options.crs` is unknown, not projected, not metric or not usable at the place.
    """
    images = sorted(map_from_cam)
    positions = usable_positions(images, shots, options)
    _require_enough(positions, len(images))
    crs = target_crs(options, positions)
    centres = np.array([map_from_cam[i].translation for i in positions.images])
    solution, witnesses, doubts = levelled(map_from_cam, shots, centres, positions, ground_normal, seed)
    _require_trustworthy(solution, centres, witnesses, doubts)
    used = solution.inlier_h
    heights = solution.inlier_h & solution.inlier_v
    residuals = {
        i: (float(e), float(n), float(u)) for i, (e, n, u) in zip(positions.images, solution.residuals, strict=True)
    }
    return GeoReference(
        enu_from_map=solution.enu_from_map,
        origin_lat_deg=positions.frame.lat_deg,
        origin_lon_deg=positions.frame.lon_deg,
        origin_height_m=positions.frame.height_m,
        crs=crs,
        vertical=positions.vertical,
        method=_method(solution, positions),
        n_used=int(used.sum()),
        n_outliers=int((~used).sum() + (used & ~solution.inlier_v & positions.has_height).sum()),
        rmse_h_m=float(np.sqrt((solution.residuals[used, :2] ** 2).sum(axis=1).mean())),
        rmse_v_m=float(np.sqrt((solution.residuals[heights, 2] ** 2).mean())) if heights.any() else float("nan"),
        residuals_m=residuals,
        warnings=(*doubts, *positions.warnings, *_warnings(solution, positions, crs)),
    )


def world_frame(reference: GeoReference) -> WorldFrame:
    """Return the export frame of a georeference: local ENU -> projected CRS and heights."""
    enu = EnuFrame(reference.origin_lat_deg, reference.origin_lon_deg, reference.origin_height_m)
    return WorldFrame(reference.crs, reference.vertical, enu)


def _require_enough(positions: Positions, placed: int) -> None:
    if positions.distinct < MIN_POSITIONS:
        raise GeoreferenceError(
            f"{len(positions.images)} of {placed} placed photographs have a position, {positions.distinct} of them "
            f"different; at least {MIN_POSITIONS} are needed. Use photographs with GPS tags, or ask for local "
            "coordinates (--local)"
        )


def levelled(
    map_from_cam: Mapping[int, Rigid3],
    shots: Mapping[int, Shot],
    centres: Float,
    positions: Positions,
    ground_normal: Float | None,
    seed: int,
) -> tuple[LevelFit, list[UpWitness], list[str]]:
    """Return the fit, the witnesses of up that it believed, and why gimbal angles were left out where they were."""
    if angles_look_up(map_from_cam, shots):
        first_up, witnesses = up_witnesses(map_from_cam, shots, ground_normal, use_angles=False)
        told = "the gimbal angles say that the cameras look up, but what they photographed lies below them"
        return fit(centres, positions, first_up, witnesses, seed), witnesses, [f"{told}: the angles were left out"]
    first_up, witnesses = up_witnesses(map_from_cam, shots, ground_normal)
    solution = fit(centres, positions, first_up, witnesses, seed)
    if any(witness.name == GIMBAL for witness in witnesses):
        other_up, others = up_witnesses(map_from_cam, shots, ground_normal, use_angles=False)
        if float(first_up @ other_up) < np.cos(np.radians(CONTRADICTION_DEG)):
            without = fit(centres, positions, other_up, others, seed)
            if without.sigma_h_m < DECIDED * solution.sigma_h_m:
                told = "the gimbal angles contradict the ground and the positions"
                return without, others, [f"{told}: the angles were left out"]
    up = solution.enu_from_map.rotation[2]
    off = [float(np.linalg.norm(witness.directions @ up)) for witness in witnesses if witness.name == GIMBAL]
    if off and off[0] > np.sin(np.radians(UNFOLLOWED_DEG)):
        return (
            solution,
            witnesses,
            ["the gimbal angles contradict the ground and the positions: they were not followed"],
        )
    return solution, witnesses, []


def _require_trustworthy(solution: LevelFit, centres: Float, witnesses: list[UpWitness], doubts: Sequence[str]) -> None:
    scaled = solution.enu_from_map.scale * (centres - centres.mean(axis=0))
    lengthwise, sideways, _ = np.linalg.svd(scaled, compute_uv=False) / np.sqrt(len(scaled))
    enu = solution.enu_from_map.apply(centres)[:, :2]
    extent = float(np.sqrt(enu.var(axis=0).sum()))
    used = int(solution.inlier_h.sum())
    if used < MIN_POSITIONS or not extent > 1.5 * solution.sigma_h_m:
        raise GeoreferenceError(
            f"the positions do not fit the map: {used} agree with it, and they scatter {solution.sigma_h_m:.1f} m "
            f"about cameras that spread {extent:.1f} m. Check the GPS tags, or ask for local coordinates (--local)"
        )
    roll_sigma_deg = float(np.degrees(solution.position_tilt_sigma.max()))
    vague = roll_sigma_deg > MAX_ROLL_SIGMA_DEG and sideways < 0.1 * lengthwise
    on_a_line = sideways < LINE_RATIO * lengthwise or vague
    if on_a_line and all(witness.name != GIMBAL for witness in witnesses):
        raise GeoreferenceError(
            f"the positions lie along one line ({lengthwise:.1f} m lengthwise, {sideways:.2f} m sideways, rms) and no "
            f"photograph has gimbal angles{' to believe (' + doubts[0] + ')' if doubts else ''}: the roll about the "
            "line stays open. Add a parallel or crossing strip, or ask for local coordinates (--local)"
        )


def metres_per_map_unit(
    map_from_cam: Mapping[int, Rigid3], shots: Mapping[int, Shot], options: GeoreferenceOptions
) -> float | None:
    """Return what the positions say of the map's scale, None where they are too few or too close together.

    The median over pairs of cameras, so that neither the level nor a few wrong positions matter.
    """
    positions = usable_positions(sorted(map_from_cam), shots, options)
    if positions.distinct < MIN_POSITIONS:
        return None
    chosen = np.linspace(0, len(positions.images) - 1, min(len(positions.images), MOST_SCALED)).astype(int)
    first, second = np.triu_indices(len(chosen), 1)
    enu = positions.enu[chosen, :2]
    centres = np.array([map_from_cam[positions.images[k]].translation for k in chosen])
    metres, units = (np.linalg.norm(points[first] - points[second], axis=1) for points in (enu, centres))
    far = (metres > FAR_SIGMAS * float(np.median(positions.sigma_h_m))) & (units > 0.0)
    return float(np.median(metres[far] / units[far])) if far.any() else None


def check_crs(shots: Mapping[int, Shot], options: GeoreferenceOptions) -> None:
    """Raise `OptionError` now if the CRS that is asked for cannot be used where the photographs were taken."""
    if options.crs is not None and not options.local:
        target_crs(options, usable_positions(sorted(shots), shots, options))


def target_crs(options: GeoreferenceOptions, positions: Positions) -> str:
    """Return the projected CRS of the result; raises `OptionError` where the one asked for cannot be used."""
    from pyproj.exceptions import ProjError

    frame = positions.frame
    if options.crs is None:
        return utm_crs_for(frame.lat_deg, frame.lon_deg)
    projected_crs(options.crs)
    if not positions.images:
        return options.crs
    transformation_accuracy_m(options.crs, frame.lat_deg, frame.lon_deg)
    try:
        there = WorldFrame(options.crs, "ellipsoidal", frame)
        back = there.to_enu(there.from_enu(np.zeros((1, 3))))
    except ProjError:
        back = np.full((1, 3), np.inf)
    if not np.abs(back).max() < 0.01:
        raise OptionError(
            f"crs: {options.crs} cannot be used at {frame.lat_deg:.4f}, {frame.lon_deg:.4f}; "
            "leave it out for the UTM zone"
        )
    _require_true_lengths(options, frame)
    return options.crs


def _require_true_lengths(options: GeoreferenceOptions, frame: EnuFrame) -> None:
    """Refuse a projection that stretches lengths where the survey lies, as Web Mercator does, unless it is forced."""
    crs, best = options.crs or "", utm_crs_for(frame.lat_deg, frame.lon_deg)
    if options.force_crs or crs.upper() == best:  # the polar system is 0.6 % short, and there is no better one
        return
    scale = scale_factor(crs, frame.lat_deg, frame.lon_deg)
    if not abs(scale - 1.0) <= MAX_SCALE_ERROR:
        raise OptionError(
            f"crs: lengths in {crs} are {scale:.4g} times the true ones where the survey lies, so distances, areas and "
            f"volumes would be wrong. Use {best} or a national grid, or insist with --force-crs"
        )


def _method(solution: LevelFit, positions: Positions) -> str:
    shares = ", ".join(f"{100.0 * share:.0f} % {name}" for name, share in solution.shares if share >= 0.005)
    return (
        f"robust similarity to {len(positions.images)} positions in local east-north-up; up direction from {shares}; "
        f"scale {solution.enu_from_map.scale:.6g} m per map unit; heights: {VERTICAL_NAMES[positions.vertical]}"
    )


def _warnings(solution: LevelFit, positions: Positions, crs: str) -> list[str]:
    warnings = []
    slope_deg = float(np.degrees(np.arctan(np.linalg.norm(solution.trend))))
    if slope_deg > 2.0 and positions.has_height.any():
        warnings.append(
            f"the positions' heights drift: they would tilt the survey by {slope_deg:.0f} degrees against the other "
            "evidence, and were not followed"
        )
    flights = int(positions.flight.max()) + 1
    if flights > 1:
        warnings.append(f"{flights} flights by pauses in capture time: a height bias was estimated for each")
    accuracy = transformation_accuracy_m(crs, positions.frame.lat_deg, positions.frame.lon_deg)
    if not accuracy <= 1.0:
        stated = "unknown" if np.isnan(accuracy) else f"{accuracy:g} m"
        warnings.append(f"accuracy of the datum shift from WGS 84 to {crs}: {stated} (PROJ)")
    return warnings
