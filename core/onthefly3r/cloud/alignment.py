"""One smooth factor of depth per photograph, so that the depth maps of overlapping photographs lie on each other.

What is left of errors in a depth map, when its cameras are known, is smooth: a tilt and a bend from intrinsics, poses
and rolling shutters that are a little wrong. The logarithm of the factor is a polynomial of second order over the
picture, six terms f(u, v). Where photograph i sees a point at depth d that photograph j, at its own pixel, sees at
depth z_j but should see at depth z_ij,

    f_i(u_i) - f_j(u_j) = log(z_j / z_ij),

and where the adjustment knows the depth z of a track, f_i(u_i) = log(z / d). Both are solved by least squares, robust
against what is no error of that kind (Cauchy's weights), and pulled gently to no change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Float, Int, UInt8
from .views import PixelTransfer, View

TERMS = 6
STEP_PX = 12  # between the pixels that are compared
CELLS = 10  # along each side of a picture: one comparison for each, the median of its pixels
LEAST_IN_CELL = 3
REACH = 0.03  # of the depth: a greater difference is another surface
TRACK_REACH = 0.2
ROUNDS = 6  # of the robust weights
PULL = 1e-3  # weight of no change, for each term, in comparisons of an average photograph
DARK, BURNT = 12, 245  # grey levels: colours beyond these are not compared
ALIKE = 0.01  # of the depth: colours of points that differ more are not compared


@dataclass(frozen=True)
class Comparison:
    """What two photographs tell of each other; rows are cells of the first one's picture."""

    first: int
    second: int
    place: Float  # (K, 2) in the picture of the first, -1..1
    other_place: Float  # (K, 2) in that of the second
    log_ratio: Float  # (K,) of depths, log(z_j / z_ij)
    log_colour: Float  # (K, 3) of the first's brightness over the second's, NaN where not comparable


@dataclass(frozen=True)
class DepthTies:
    """Depths that the adjustment knows in one photograph."""

    place: Float  # (K, 2) in its picture, -1..1
    log_ratio: Float  # (K,) log of the adjusted depth over that of its map


@dataclass(frozen=True)
class Alignment:
    """The factors and how well the maps agree, relative to depth, before and after (normalised median deviations)."""

    terms: Mapping[int, Float]  # (6,) by shot index
    before: float
    after: float


def compare(
    first: int,
    second: int,
    views: Mapping[int, View],
    depths: tuple[Float, Float],
    colours: tuple[UInt8, UInt8] | None = None,
    step_px: int = STEP_PX,
) -> Comparison | None:
    """Return the comparison of two depth maps (H, W), 0 where unknown, None where they share no surface.

    colours: of both photographs (H, W, 3), smoothed; without them none are compared.
    """
    own, other = depths
    height, width = own.shape
    rows, columns = (a.ravel() for a in np.mgrid[step_px // 2 : height : step_px, step_px // 2 : width : step_px])
    depth = own[rows, columns].astype(float)
    known = depth > 0.0
    rows, columns, depth = rows[known], columns[known], depth[known]
    transfer = PixelTransfer.between(views[first], views[second])
    here = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    x, y, z = depth * (transfer.matrix @ here) + transfer.offset[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        there = np.stack([x / z, y / z], axis=-1)
        cells = np.floor(np.where((z > 0.0)[:, None] & (np.abs(there) < 1e6), there, -1.0)).astype(int)
    size = np.array([other.shape[1], other.shape[0]])
    inside = ((cells >= 0) & (cells < size)).all(axis=-1)
    seen = np.zeros(len(rows))
    seen[inside] = other[cells[inside, 1], cells[inside, 0]]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_ratio = np.log(seen / z)
    near = np.flatnonzero(np.abs(log_ratio) < REACH)
    if len(near) < LEAST_IN_CELL:
        return None
    place = 2.0 * here[:2, near].T / (width, height) - 1.0
    other_place = 2.0 * there[near] / size - 1.0
    log_colour = np.full((len(near), 3), np.nan)
    if colours is not None:
        pair = (
            colours[0][rows[near], columns[near]].astype(float),
            colours[1][cells[near, 1], cells[near, 0]].astype(float),
        )
        fair = (np.minimum(*pair).min(axis=1) > DARK) & (np.maximum(*pair).max(axis=1) < BURNT)
        fair &= np.abs(log_ratio[near]) < ALIKE
        log_colour[fair] = np.log(pair[0][fair] / pair[1][fair])
    return _by_cell(first, second, place, other_place, log_ratio[near], log_colour)


def _by_cell(
    first: int, second: int, place: Float, other_place: Float, log_ratio: Float, log_colour: Float
) -> Comparison | None:
    """Return one row per cell of the picture: the pixel of the median ratio, and the mean of the colours."""
    cell = np.minimum((0.5 * (place + 1.0) * CELLS).astype(int), CELLS - 1) @ (1, CELLS)
    order = np.lexsort((log_ratio, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    enough = counts >= LEAST_IN_CELL
    if not enough.any():
        return None
    median = order[(starts + counts // 2)[enough]]
    fair = np.isfinite(log_colour[order, 0])
    total = np.add.reduceat(np.where(fair[:, None], log_colour[order], 0.0), starts)[enough]
    number = np.add.reduceat(fair.astype(int), starts)[enough]
    with np.errstate(divide="ignore", invalid="ignore"):
        colour = np.where((number >= LEAST_IN_CELL)[:, None], total / number[:, None], np.nan)
    return Comparison(first, second, place[median], other_place[median], log_ratio[median], colour)


def align(
    indices: Sequence[int], comparisons: Sequence[Comparison], ties: Mapping[int, DepthTies] | None = None
) -> Alignment:
    """Return the factors of all photographs; those that nothing is known of keep theirs at 1."""
    from scipy.sparse import coo_matrix, identity
    from scipy.sparse.linalg import spsolve

    row_of = {index: row for row, index in enumerate(indices)}
    bases, others, first, second, wanted = _equations(comparisons, ties or {}, row_of)
    n, m = len(indices), len(wanted)
    if m == 0:
        return Alignment({index: np.zeros(TERMS) for index in indices}, float("nan"), float("nan"))
    equation = np.repeat(np.arange(m), TERMS)
    column = (first[:, None] * TERMS + np.arange(TERMS)).ravel()
    other_column = (np.maximum(second, 0)[:, None] * TERMS + np.arange(TERMS)).ravel()
    others = np.where((second >= 0)[:, None], -others, 0.0)
    matrix = coo_matrix(
        (
            np.concatenate([bases.ravel(), others.ravel()]),
            (np.concatenate([equation, equation]), np.concatenate([column, other_column])),
        ),
        shape=(m, n * TERMS),
    ).tocsr()
    pull = PULL * m / n * identity(n * TERMS)
    terms, tie = np.zeros(n * TERMS), second < 0
    before = _spread(wanted[~tie])
    for _ in range(ROUNDS):
        residual = wanted - matrix @ terms
        weight = np.zeros(m)
        for group in (tie, ~tie):  # each has a noise of its own
            if group.any():
                scale = 2.0 * _spread(residual[group]) + 1e-9
                weight[group] = 1.0 / (1.0 + (residual[group] / scale) ** 2)
        weighted = matrix.multiply(weight[:, None]).tocsr()
        terms = spsolve((matrix.T @ weighted + pull).tocsc(), weighted.T @ wanted)
    after = _spread((wanted - matrix @ terms)[~tie])
    return Alignment({i: terms[r * TERMS : (r + 1) * TERMS] for i, r in row_of.items()}, before, after)


def factors(terms: Float, width: int, height: int) -> Float:
    """Return the factors of depth (H, W) float32 over a picture."""
    u = 2.0 * (np.arange(width) + 0.5) / width - 1.0
    v = 2.0 * (np.arange(height) + 0.5)[:, None] / height - 1.0
    one, along, down, along2, down2, both = terms
    log_factor = (one + along * u + along2 * u * u) + (down * v + down2 * v * v) + both * (u * v)
    return np.asarray(np.exp(log_factor), np.float32)


def basis(place: Float) -> Float:
    """Return the six terms (N, 6) at places (N, 2) of a picture, -1..1 along each side."""
    u, v = place.T
    return np.stack([np.ones(len(u)), u, v, u * u, v * v, u * v], axis=-1)


def _equations(
    comparisons: Sequence[Comparison], ties: Mapping[int, DepthTies], row_of: Mapping[int, int]
) -> tuple[Float, Float, Int, Int, Float]:
    """Return bases of both photographs (M, 6), their rows (M,), -1 for a tie, and the wanted differences (M,)."""
    bases: list[Float] = [np.zeros((0, TERMS))]
    others: list[Float] = [np.zeros((0, TERMS))]
    wanted: list[Float] = [np.zeros(0)]
    first: list[Int] = [np.zeros(0, int)]
    second: list[Int] = [np.zeros(0, int)]
    for item in comparisons:
        bases.append(basis(item.place))
        others.append(basis(item.other_place))
        wanted.append(item.log_ratio)
        first.append(np.full(len(item.log_ratio), row_of[item.first]))
        second.append(np.full(len(item.log_ratio), row_of[item.second]))
    for index, tie in ties.items():
        bases.append(basis(tie.place))
        others.append(np.zeros((len(tie.log_ratio), TERMS)))
        wanted.append(tie.log_ratio)
        first.append(np.full(len(tie.log_ratio), row_of[index]))
        second.append(np.full(len(tie.log_ratio), -1))
    return (
        np.concatenate(bases),
        np.concatenate(others),
        np.concatenate(first),
        np.concatenate(second),
        np.concatenate(wanted),
    )


def _spread(values: Float) -> float:
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else float("nan")
