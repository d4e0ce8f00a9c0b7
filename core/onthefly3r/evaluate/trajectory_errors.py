"""Errors of camera poses against reference poses: ATE, ARE, RTE, RRE and coverage.

All are root mean squares over the common images after one alignment of the camera centres (Umeyama 1991). Absolute
errors follow Sturm et al. 2012 ("A Benchmark for the Evaluation of RGB-D SLAM Systems"); relative ones compare
consecutive images in capture order: RTE is the angle between their translation vectors, each in the first camera's
frame, RRE the angle between their relative rotations. Both are free of the alignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import ReferenceFormatError
from ..geometry.arrays import Float
from ..geometry.transforms import Sim3
from ..geometry.umeyama import weighted_similarity
from .poses import PoseSet, match

Align = Literal["sim3", "se3", "none"]


@dataclass(frozen=True)
class PoseErrors:
    """Root mean squares over the common images; lengths in the unit of the reference."""

    n_common: int
    n_estimate: int
    n_reference: int
    ate: float
    are_deg: float
    rte_deg: float | None  # None where no two consecutive images differ in place
    rre_deg: float | None
    reference_from_estimate: Sim3
    per_image: tuple[tuple[str, float, float], ...]  # image, position error, rotation error deg

    @property
    def coverage(self) -> float:
        """Share of the reference's images that the estimate has."""
        return self.n_common / self.n_reference


def pose_errors(
    estimate: PoseSet, reference: PoseSet, align: Align = "sim3", only: Sequence[PoseSet] = ()
) -> PoseErrors:
    """Compare two pose sets over the images they share.

    Args:
        estimate: in capture order.
        reference: any order; the errors are in its unit.
        align: what is fitted to the common centres first: sim3, se3 (scale 1) or nothing.
        only: further pose sets; only images that all of them hold too are used, and the alignment is fitted to those
            alone (the common-frame variant, by which methods of different coverage are compared).

    Raises:
        ReferenceFormatError: nothing in common, or too few or collinear centres to align.
    """
    rows, reference_rows = match(estimate, reference)
    for other in only:
        shared = np.isin(rows, match(estimate, other)[0])
        rows, reference_rows = rows[shared], reference_rows[shared]
    if not len(rows):
        names = ", ".join(str(other.source) for other in only)
        raise ReferenceFormatError(f"{estimate.source}: no image is in all of {reference.source}, {names}")
    found, truth = estimate.take(rows), reference.take(reference_rows)
    reference_from_estimate = alignment(found, truth, align)
    moved = found.moved(reference_from_estimate)
    distance = np.linalg.norm(moved.centres - truth.centres, axis=1)
    angle_deg = rotation_angles_deg(np.swapaxes(truth.rotations, 1, 2) @ moved.rotations)
    rte_deg, rre_deg = _relative_errors_deg(found, truth)
    return PoseErrors(
        n_common=len(rows),
        n_estimate=len(estimate.names),
        n_reference=len(reference.names),
        ate=_rms(distance),
        are_deg=_rms(angle_deg),
        rte_deg=rte_deg,
        rre_deg=rre_deg,
        reference_from_estimate=reference_from_estimate,
        per_image=tuple(zip(truth.names, distance.tolist(), angle_deg.tolist(), strict=True)),
    )


def alignment(estimate: PoseSet, reference: PoseSet, align: Align) -> Sim3:
    """Return reference_from_estimate of two sets with the same images in the same order."""
    if align == "none":
        return Sim3()
    weight = np.ones(len(estimate.names))
    try:
        return weighted_similarity(estimate.centres, reference.centres, weight, with_scale=align == "sim3")
    except ValueError as error:
        raise ReferenceFormatError(
            f"{estimate.source}: its {len(weight)} common cameras cannot be aligned to {reference.source}: {error}"
        ) from None


def rotation_angles_deg(rotations: Float) -> Float:
    """Return the angles (N,) in degrees of rotations (N, 3, 3), accurate for small ones too."""
    # |R - I| in the Frobenius norm is 2 sqrt(2) sin(angle / 2); the arc cosine of the trace loses small angles.
    chord = np.linalg.norm(rotations - np.eye(3), axis=(1, 2)) / (2.0 * np.sqrt(2.0))
    return np.asarray(np.degrees(2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))))


def _relative_errors_deg(estimate: PoseSet, reference: PoseSet) -> tuple[float | None, float | None]:
    """Return (RTE, RRE) over consecutive images; pairs without a baseline have no direction and are left out of RTE."""
    if len(estimate.names) < 2:
        return None, None
    step, rotation = _steps(estimate)
    true_step, true_rotation = _steps(reference)
    usable = (_norm(step) > _tiny(estimate.centres)) & (_norm(true_step) > _tiny(reference.centres))
    rte = angles_between_deg(step[usable], true_step[usable])
    rre = rotation_angles_deg(np.swapaxes(true_rotation, 1, 2) @ rotation)
    return (_rms(rte) if len(rte) else None), _rms(rre)


def angles_between_deg(a: Float, b: Float) -> Float:
    """Return the angles (N,) in degrees between vectors (N, 3)."""
    return np.asarray(np.degrees(np.arctan2(_norm(np.cross(a, b)), (a * b).sum(axis=1))))


def _steps(poses: PoseSet) -> tuple[Float, Float]:
    """Return translation and rotation from each image to the next, in the first camera's frame."""
    cam_from_world = np.swapaxes(poses.rotations[:-1], 1, 2)
    translation = np.einsum("nij,nj->ni", cam_from_world, np.diff(poses.centres, axis=0))
    return translation, cam_from_world @ poses.rotations[1:]


def _tiny(centres: Float) -> float:
    return 1e-9 * float(np.ptp(centres, axis=0).max())


def _norm(vectors: Float) -> Float:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
