"""Marks of control points in placed cameras: which copy of a photograph was marked, points from marks, wrong marks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from ..adjust.intrinsics import projection_jacobians
from ..geometry.arrays import Bool, Float, Int
from ..geometry.camera import Camera
from ..geometry.orientation import upright_pixels
from ..geometry.transforms import Rigid3
from ..records import Shot
from .control import Control, Mark

MARK_SIGMA_PX = 1.0  # of a mark in its photograph
# Longest sides of copies that people mark in, tried where marks do not fit the photographs as they are.
COPIES_PX: tuple[int, ...] = (
    *(640, 800, 1000, 1024, 1200, 1280, 1400, 1500, 1600, 1920, 2000, 2048, 2400, 2500, 2560, 3000, 3072, 3200),
    *(3264, 3648, 4000, 4032, 4056, 4096, 4272, 4608, 4864, 4896, 5000, 5184, 5280, 5456, 5472, 6000, 6016, 7360),
    *(7952, 8000, 8192, 8256, 9504),
)
FITS = 0.006  # of the longest side: marks of one point meet so well, in the median, where the copy is right
WRONG_MARK = 0.01  # of the longest side: the least by which a wrong mark is off
WRONG_FACTOR = 6.0  # times the usual misfit of marks
STEPS = 15


@dataclass(frozen=True)
class PlacedMarks:
    """Marks in placed cameras, in pixels of the upright photographs."""

    label: tuple[str, ...]  # (M,)
    image: Int  # (M,) row of the camera
    pixel: Float  # (M, 2)
    warnings: tuple[str, ...] = ()

    def of(self, label: str) -> Int:
        """Return the rows of one point's marks."""
        return np.flatnonzero(np.array(self.label) == label)

    def without(self, rows: Bool) -> PlacedMarks:
        """Return the marks but those of the mask (M,)."""
        label = tuple(name for name, out in zip(self.label, rows, strict=True) if not out)
        return PlacedMarks(label, self.image[~rows], self.pixel[~rows], self.warnings)


def placed_marks(
    control: Control, images: Sequence[int], shots: Mapping[int, Shot], poses: Sequence[Rigid3], cameras: list[Camera]
) -> PlacedMarks:
    """Return the marks that lie in placed photographs, brought to their pixels.

    Marks may have been made in a scaled copy, and in the file as stored instead of upright: of all copies that marks
    fit into, the one whose marks meet best in space is taken, the photograph as it is wherever that fits.
    """
    row_of = _rows_by_name(images, shots)
    found: dict[tuple[str, int], Mark] = {}
    missing: list[str] = []
    for mark in control.marks:
        row = row_of.get(_key(mark.image), row_of.get(_key(PurePosixPath(_key(mark.image)).name)))
        if row is None:
            missing.append(mark.image)
        else:
            found[mark.label, row] = mark
    warnings = []
    if missing:
        names = ", ".join(sorted(set(missing))[:5])
        warnings.append(
            f"control: {len(missing)} of {len(control.marks)} marks lie in photographs that are not placed ({names})"
        )
    keys, marks = list(found), list(found.values())
    image = np.array([row for _, row in keys], int)
    label = tuple(name for name, _ in keys)
    raw = np.array([(mark.x_px, mark.y_px) for mark in marks]).reshape(-1, 2)
    placed = [shots[images[row]] for row in image]
    sizes = np.array([(shot.width_px, shot.height_px) for shot in placed], float).reshape(-1, 2)
    turn = np.array([shot.orientation for shot in placed], int)
    told = np.array([np.nan if mark.width_px is None else mark.width_px for mark in marks])
    pixel, note = _in_photographs(label, image, raw, sizes, turn, told, poses, cameras)
    inside = _inside(pixel, sizes)
    for k in np.flatnonzero(~inside):
        warnings.append(
            f"control: {marks[k].where}: the mark of {label[k]} lies outside {marks[k].image} and is left out"
        )
    result = PlacedMarks(label, image, pixel, tuple(warnings + note))
    return result.without(~inside)


def triangulated(pixels: Float, poses: Sequence[Rigid3], cameras: Sequence[Camera]) -> tuple[Float, Float, Float]:
    """Return the point (3,) that K >= 2 marks (K, 2) see, its misfits in pixels (K,) and covariance for 1 px (3, 3).

    Raises `ValueError` where the rays are parallel.
    """
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for pixel, pose, camera in zip(pixels, poses, cameras, strict=True):
        ray = pose.rotation @ camera.rays(pixel)
        ray = ray / np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix, right = matrix + across, right + across @ pose.translation
    if not np.linalg.eigvalsh(matrix)[0] > 1e-7 * len(pixels):
        raise ValueError("the rays to the marks are parallel")
    point = np.linalg.solve(matrix, right)
    for _ in range(STEPS):
        residual, jacobian = _reprojected(point, pixels, poses, cameras)
        step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
        if not np.isfinite(step).all():
            raise ValueError("the marks meet behind a camera")
        point = point + step
        if np.linalg.norm(step) < 1e-12 * (1.0 + np.linalg.norm(point)):
            break
    residual, jacobian = _reprojected(point, pixels, poses, cameras)
    if not np.isfinite(residual).all():
        raise ValueError("the marks meet behind a camera")
    return point, np.linalg.norm(residual.reshape(-1, 2), axis=1), np.linalg.pinv(jacobian.T @ jacobian)


def wrong_marks(marks: PlacedMarks, poses: Sequence[Rigid3], cameras: Sequence[Camera]) -> tuple[Bool, list[str]]:
    """Return which marks (M,) disagree with the others of their point, and what to say of them.

    Of three or more marks one can be told wrong; two that do not meet leave their point without any.
    """
    wrong, told = np.zeros(len(marks.label), bool), []
    usual = max(_usual_misfit(marks.label, marks.image, marks.pixel, poses, cameras), 0.5)
    for label in sorted(set(marks.label)):
        rows = marks.of(label)
        while len(rows) >= 2:
            longest = max(max(cameras[k].width, cameras[k].height) for k in marks.image[rows])
            gate = max(WRONG_MARK * longest, WRONG_FACTOR * usual)
            if _misfit(rows, marks, poses, cameras) <= gate:
                break
            if len(rows) == 2:
                wrong[rows] = True
                told.append(f"control: the two marks of {label} do not meet; both are left out")
                break
            rest = [_misfit(np.delete(rows, k), marks, poses, cameras) for k in range(len(rows))]
            worst = int(np.argmin(rest))
            wrong[rows[worst]] = True
            told.append(
                f"control: a mark of {label} ({tuple(marks.pixel[rows[worst]].round(1).tolist())}) does not meet the "
                "others and is left out; is it on another target?"
            )
            rows = np.delete(rows, worst)
    return wrong, told


def _misfit(rows: Int, marks: PlacedMarks, poses: Sequence[Rigid3], cameras: Sequence[Camera]) -> float:
    try:
        seen = marks.image[rows]
        misfits = triangulated(marks.pixel[rows], [poses[k] for k in seen], [cameras[k] for k in seen])[1]
        return float(misfits.max())
    except ValueError:
        return float("inf")


def _reprojected(
    point: Float, pixels: Float, poses: Sequence[Rigid3], cameras: Sequence[Camera]
) -> tuple[Float, Float]:
    residual, jacobian = [], []
    for pixel, pose, camera in zip(pixels, poses, cameras, strict=True):
        seen = pose.rotation.T @ (point - pose.translation)
        residual.append(pixel - camera.project(seen))
        jacobian.append(projection_jacobians(camera, seen[None])[0][0] @ pose.rotation.T)
    return np.concatenate(residual), np.concatenate(jacobian)


def _in_photographs(
    label: tuple[str, ...],
    image: Int,
    raw: Float,
    sizes: Float,
    turn: Int,
    told_width: Float,
    poses: Sequence[Rigid3],
    cameras: list[Camera],
) -> tuple[Float, list[str]]:
    """Return the marks (M, 2) in upright photographs, and what was found out about the copies."""
    longest = sizes.max(axis=1, initial=1.0)
    turned = turn > 1
    if np.isfinite(told_width).any():
        widths = np.where(np.isfinite(told_width), told_width, sizes[:, 0])
        # A width tells the orientation too: that of the file as stored, or upright.
        scale = np.where(np.abs(widths / sizes[:, 0] - 1.0) < 1e-3, 1.0, sizes[:, 0] / widths)
        return raw * scale[:, None], []
    best, best_misfit, note = raw, np.inf, []
    for side in (0, *COPIES_PX):
        scaled = raw * (1.0 if side == 0 else (longest / side)[:, None])
        for stored in (False, True) if turned.any() else (False,):
            pixel = _oriented(scaled, sizes, turn, stored)
            if not _mostly_inside(pixel, sizes):
                continue
            misfit = _usual_misfit(label, image, pixel, poses, cameras) / float(np.median(longest))
            if misfit < (best_misfit if np.isinf(best_misfit) or best_misfit > FITS else 0.5 * best_misfit):
                best, best_misfit = pixel, misfit
                copy = f"copies of {side} px" if side else "the photographs as they are"
                note = [f"control: marks are in pixels of {copy}{', not turned upright' if stored else ''}"]
        if side == 0 and best_misfit <= FITS:
            return best, [] if "not turned" not in "".join(note) else note
    return best, note


def _oriented(pixel: Float, sizes: Float, turn: Int, stored: bool) -> Float:
    """Return marks in upright photographs; those that lie outside are tried in the other orientation."""
    from_stored = np.array(
        [upright_pixels(one, size[0], size[1], int(code)) for one, size, code in zip(pixel, sizes, turn, strict=True)]
    ).reshape(-1, 2)
    first, second = (from_stored, pixel) if stored else (pixel, from_stored)
    return np.where(_inside(first, sizes)[:, None], first, second)


def _inside(pixel: Float, sizes: Float) -> Bool:
    return np.asarray(((pixel >= -1.0) & (pixel <= sizes + 1.0)).all(axis=1), bool)


def _mostly_inside(pixel: Float, sizes: Float) -> bool:
    return len(pixel) > 0 and float(_inside(pixel, sizes).mean()) >= 0.8


def _usual_misfit(
    label: tuple[str, ...], image: Int, pixel: Float, poses: Sequence[Rigid3], cameras: Sequence[Camera]
) -> float:
    """Return the median over points of the median misfit of their marks in pixels; infinite without any pair."""
    marks, misfits = PlacedMarks(label, image, pixel), []
    for name in sorted(set(label)):
        rows = marks.of(name)
        if len(rows) < 2:
            continue
        seen = image[rows]
        try:
            found = triangulated(pixel[rows], [poses[k] for k in seen], [cameras[k] for k in seen])[1]
            misfits.append(float(np.median(found)))
        except ValueError:
            misfits.append(float(max(cameras[k].width for k in seen)))
    return float(np.median(misfits)) if misfits else float("inf")


def _rows_by_name(images: Sequence[int], shots: Mapping[int, Shot]) -> dict[str, int]:
    """Return the row of each photograph by its path and, where it is unique, by its file name."""
    names: dict[str, list[int]] = {}
    for row, index in enumerate(images):
        for name in {_key(shots[index].name), _key(PurePosixPath(shots[index].name).name)}:
            names.setdefault(name, []).append(row)
    return {name: rows[0] for name, rows in names.items() if len(rows) == 1}


def _key(name: str) -> str:
    return name.replace("\\", "/").casefold()
