"""The geometry of a made-up landscape: hills, box and gabled buildings, trees, look-alike blocks; all triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..geometry.arrays import Float, Int
from .texture import ROAD_HALF_WIDTH_M, Texture

GROUND, ROOF, WALL, TREE = 0, 1, 2, 3
BLOCK_SIZE_M = 60.0
HOUSE_REACH_M = 12.0  # from the middle of the largest house to its corners
MAX_OBJECTS = 4000  # of each kind, whatever the extent
ROOF_COLOURS = ((168, 86, 66), (126, 64, 56), (110, 112, 120), (150, 138, 124), (92, 84, 82), (176, 170, 164))
WALL_COLOURS = ((206, 200, 186), (188, 168, 140), (170, 172, 176))


@dataclass(frozen=True, eq=False)
class Patch:
    """Triangles of one kind; a texture plane gives texture coordinates (u . p + offset_u, v . p + offset_v)."""

    triangles: Float  # (T, 3, 3) ENU m, counter-clockwise seen from outside
    material: int
    colour: Float  # (3,) base colour 0..255
    axis_u: Float  # (3,)
    axis_v: Float  # (3,)
    offset: Float  # (2,) m


@dataclass(frozen=True, eq=False)
class Hills:
    """A smooth height field: a sum of plane waves about height 0."""

    amplitudes_m: Float  # (K,)
    wave_vectors: Float  # (K, 2) rad/m
    phases: Float  # (K,)

    @classmethod
    def draw(cls, height_m: float, rng: np.random.Generator) -> Hills:
        """Draw eight waves of 70 to 350 m length whose heights sum to `height_m`."""
        lengths = np.geomspace(70.0, 350.0, 8)
        angles = rng.uniform(0.0, 2.0 * np.pi, 8)
        vectors = 2.0 * np.pi / lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return cls(height_m * lengths / lengths.sum(), vectors, rng.uniform(0.0, 2.0 * np.pi, 8))

    def height(self, x: Float, y: Float) -> Float:
        """Return the ground height in metres at east x, north y (any equal shapes)."""
        total = np.zeros(np.shape(x))
        for amplitude, (kx, ky), phase in zip(self.amplitudes_m, self.wave_vectors, self.phases, strict=True):
            total += amplitude * np.sin(kx * np.asarray(x) + ky * np.asarray(y) + phase)
        return total


def ground_patch(hills: Hills, bounds: tuple[float, float, float, float], cell_m: float) -> Patch:
    """Return the height field over (west, south, east, north) as a regular net of triangles."""
    west, south, east, north = bounds
    columns, rows = (max(2, int(np.ceil(side / cell_m)) + 1) for side in (east - west, north - south))
    x, y = np.meshgrid(np.linspace(west, east, columns), np.linspace(south, north, rows))
    vertices = np.stack([x, y, hills.height(x, y)], axis=-1)
    a, b, c, d = vertices[:-1, :-1], vertices[:-1, 1:], vertices[1:, :-1], vertices[1:, 1:]
    triangles = np.concatenate([np.stack([a, b, d], axis=-2), np.stack([a, d, c], axis=-2)]).reshape(-1, 3, 3)
    return Patch(triangles, GROUND, np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.zeros(2))


def building(centre: Float, size: Float, yaw: float, floor_m: float, gable_m: float, look: int) -> list[Patch]:
    """Return the roof and walls of a house.

    centre (2,) m; size (length, width, eaves height) m; yaw rad; floor_m: height of the ground there;
    gable_m: ridge above the eaves, 0 for a flat roof; houses of the same size and `look` are indistinguishable.
    """
    east, north = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    half_length, half_width = size[0] / 2 * east, size[1] / 2 * north
    middle = np.array([centre[0], centre[1], floor_m])
    corners = [middle + i * half_length + j * half_width for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    foot, eaves = [c - 2.0 * up for c in corners], [c + size[2] * up for c in corners]
    ridge = [middle + i * half_length + (size[2] + gable_m) * up for i in (-1, 1)]
    phase = np.array([17.3, 5.1]) * (1 + look)

    def face(material: int, colour: tuple[int, int, int], u: Float, v: Float, *outline: Float) -> Patch:
        fan = [[outline[0], outline[i], outline[i + 1]] for i in range(1, len(outline) - 1)]
        offset = phase - (u @ middle, v @ middle)
        return Patch(np.array(fan), material, np.array(colour, float), u, v, offset)

    roof, wall = ROOF_COLOURS[look % len(ROOF_COLOURS)], WALL_COLOURS[look % len(WALL_COLOURS)]
    gables = ([ridge[1]], [ridge[0]]) if gable_m > 0.0 else ([], [])
    patches = [
        face(WALL, wall, east, up, foot[0], foot[1], eaves[1], eaves[0]),
        face(WALL, wall, north, up, foot[1], foot[2], eaves[2], *gables[0], eaves[1]),
        face(WALL, wall, -east, up, foot[2], foot[3], eaves[3], eaves[2]),
        face(WALL, wall, -north, up, foot[3], foot[0], eaves[0], *gables[1], eaves[3]),
    ]
    if gable_m > 0.0:
        patches.append(face(ROOF, roof, east, north, eaves[0], eaves[1], ridge[1], ridge[0]))
        patches.append(face(ROOF, roof, east, north, eaves[2], eaves[3], ridge[0], ridge[1]))
    else:
        patches.append(face(ROOF, roof, east, north, *eaves))
    return patches


@lru_cache(maxsize=1)
def _unit_sphere() -> tuple[Float, Int]:
    """Return vertices (V, 3) and faces (F, 3)."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def tree(centre: Float, radius_m: float, floor_m: float, rng: np.random.Generator) -> Patch:
    """Return a lumpy crown that stands on the ground at centre (2,)."""
    sphere, faces = _unit_sphere()
    lumps = 1.0 + 0.12 * rng.standard_normal((len(sphere), 1))
    vertices = sphere * lumps * radius_m * (1.0, 1.0, rng.uniform(0.9, 1.6))
    vertices += (centre[0], centre[1], floor_m - 0.3 - vertices[:, 2].min())
    green = np.array((52, 82, 40), float) * rng.uniform(0.8, 1.3)
    slanted_u, slanted_v = np.array([1.0, 0.0, 0.7]), np.array([0.0, 1.0, -0.4])
    return Patch(vertices[faces], TREE, green, slanted_u, slanted_v, rng.uniform(0.0, 500.0, 2))


def scatter_objects(
    hills: Hills,
    bounds: tuple[float, float, float, float],
    blocks: Float,
    building_spacing_m: float,
    tree_spacing_m: float,
    rng: np.random.Generator,
) -> list[Patch]:
    """Return houses and trees off the roads, and the same group of houses in every look-alike block.

    blocks (B, 2): the blocks' south-west corners, ENU m; nothing else stands in them.
    """
    patches: list[Patch] = []
    houses = [np.full(2, np.inf)]
    for x, y in _jittered_grid(bounds, building_spacing_m, rng):
        size = np.array([rng.uniform(9.0, 20.0), rng.uniform(8.0, 13.0), rng.uniform(3.0, 9.0)])
        yaw, look = rng.uniform(0.0, np.pi), int(rng.integers(1_000))
        gable_m = rng.uniform(1.5, 3.5) if rng.random() < 0.6 else 0.0
        if rng.random() < 0.75 and _is_free(x, y, 10.0 + ROAD_HALF_WIDTH_M, blocks):
            patches += building(np.array([x, y]), size, yaw, float(hills.height(x, y)), gable_m, look)
            houses.append(np.array([x, y]))
    centres = np.array(houses)
    for x, y in _jittered_grid(bounds, tree_spacing_m, rng):
        radius_m = rng.uniform(1.2, 3.2)
        apart = np.linalg.norm(centres - (x, y), axis=-1).min() > HOUSE_REACH_M + radius_m
        if apart and rng.random() < 0.6 and _is_free(x, y, radius_m + ROAD_HALF_WIDTH_M, blocks):
            patches.append(tree(np.array([x, y]), radius_m, float(hills.height(x, y)), rng))
    for corner_x, corner_y in blocks:
        for column, row in ((0.2, 0.2), (0.7, 0.2), (0.2, 0.7), (0.7, 0.75)):
            x, y = corner_x + column * BLOCK_SIZE_M, corner_y + row * BLOCK_SIZE_M
            floor_m = float(hills.height(x, y))
            patches += building(np.array([x, y]), np.array([14.0, 10.0, 5.0]), 0.3, floor_m, 2.5, look=3)
    return patches


def place_blocks(bounds: tuple[float, float, float, float]) -> Float:
    """Return the south-west corners (B, 2) of look-alike blocks, spread over the middle of the extent."""
    west, south, east, north = bounds
    columns, rows = (max(2, min(6, int(side // (3 * BLOCK_SIZE_M)))) for side in (east - west, north - south))
    x = west + (east - west) * (np.arange(columns) + 0.5) / columns - BLOCK_SIZE_M / 2
    y = south + (north - south) * (np.arange(rows) + 0.5) / rows - BLOCK_SIZE_M / 2
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _jittered_grid(bounds: tuple[float, float, float, float], spacing_m: float, rng: np.random.Generator) -> Float:
    """Return at most `MAX_OBJECTS` places (N, 2), one at random in each cell of a grid."""
    west, south, east, north = bounds
    spacing_m = max(spacing_m, float(np.sqrt((east - west) * (north - south) / MAX_OBJECTS)))
    x, y = np.meshgrid(np.arange(west, east - spacing_m, spacing_m), np.arange(south, north - spacing_m, spacing_m))
    corners = np.stack([x, y], axis=-1).reshape(-1, 2)
    return np.asarray(corners + spacing_m * rng.uniform(0.25, 0.75, corners.shape))


def _is_free(x: float, y: float, clearance_m: float, blocks: Float) -> bool:
    """Tell whether an object at (x, y) keeps clear of roads and look-alike blocks."""
    here = np.array([x]), np.array([y])
    off_roads = min(Texture.distance_to_road(*here)[0], Texture.distance_to_road(*here[::-1])[0]) > clearance_m
    offset = np.array([x, y]) - blocks
    inside = np.all((offset > -clearance_m) & (offset < BLOCK_SIZE_M + clearance_m), axis=-1)
    return bool(off_roads and not inside.any())
