"""A made-up landscape that can be ray-cast, coloured and measured: the truth of every simulated survey.

Everything is in a local east-north-up frame in metres about the survey's origin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..geometry.arrays import Float, Int, UInt8
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3
from .landscape import (
    BLOCK_SIZE_M,
    GROUND,
    ROOF,
    TREE,
    WALL,
    Hills,
    Patch,
    ground_patch,
    place_blocks,
    scatter_objects,
)
from .texture import Texture

SUN = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
GRAZING = 1e-4  # disagreement of the two precisions, relative, that tells a ray along the plane
NEAREST_TRIANGLES = 12  # candidates of an exact point-to-triangle distance
QUERY_EDGE_M = 3.0  # longest edge of those triangles
QUERY_CHUNK = 20_000
SKY = (150.0, 180.0, 215.0)


@dataclass(frozen=True)
class Hits:
    """Where rays meet the surface; misses have face -1 and NaN elsewhere."""

    distances: Float  # (N,) in lengths of the ray's direction
    points: Float  # (N, 3) ENU m
    normals: Float  # (N, 3) unit, outward
    faces: Int  # (N,) triangle of the scene


@dataclass(frozen=True, eq=False)
class Scene:
    """Terrain, buildings and trees as one triangle soup with a texture plane per triangle."""

    triangles: Float  # (F, 3, 3) ENU m, counter-clockwise seen from outside
    material: Int  # (F,) GROUND, ROOF, WALL, TREE
    base_colour: Float  # (F, 3) float32 0..255
    texture_axes: Float  # (F, 2, 3) float32
    texture_offset: Float  # (F, 2) float32 m
    hills: Hills
    blocks: Float  # (B, 2) south-west corners of the look-alike blocks, ENU m
    texture: Texture
    bounds: tuple[float, float, float, float]  # west, south, east, north, ENU m

    @cached_property
    def normals(self) -> Float:
        """Unit normals (F, 3)."""
        cross = np.cross(self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0])
        return np.asarray(cross / np.linalg.norm(cross, axis=-1, keepdims=True))

    @cached_property
    def _plane_offsets(self) -> Float:
        """n . p (F,) of every triangle's plane."""
        return np.asarray(np.einsum("fi,fi->f", self.normals, self.triangles[:, 0]))

    @cached_property
    def _light(self) -> Float:
        """Brightness (F,) float32 of every triangle under the sun; shadows are not cast."""
        return np.asarray(0.62 + 0.46 * np.clip(self.normals @ SUN, 0.0, None), np.float32)

    @cached_property
    def _embree(self) -> Any:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        scene = rtcore_scene.EmbreeScene()
        TriangleMesh(scene, self.triangles.astype(np.float32))
        return scene

    def cast(self, origins: Float, directions: Float) -> Hits:
        """Return the first hit of each ray.

        origins (3,) or (N, 3) ENU m, directions (N, 3) of any length. Embree finds the triangle in single
        precision; the distance is then computed in double precision on the triangle's plane, except where the ray
        runs along the plane.
        """
        directions = np.asarray(directions, float)
        origins = np.broadcast_to(np.asarray(origins, float), directions.shape)
        start, towards = (np.ascontiguousarray(a, np.float32) for a in (origins, directions))
        found = self._embree.run(start, towards, output=1)
        faces, rough = np.asarray(found["primID"], np.int64), np.asarray(found["tfar"], float)
        normals = self.normals[faces]
        height = self._plane_offsets[faces] - np.einsum("ni,ni->n", normals, origins)
        with np.errstate(divide="ignore", invalid="ignore"):
            distances = height / np.einsum("ni,ni->n", directions, normals)
            distances = np.where(np.abs(distances - rough) < GRAZING * rough, distances, rough)
        missed = faces < 0
        distances[missed], normals[missed] = np.nan, np.nan
        return Hits(distances, origins + distances[:, None] * directions, normals, faces)

    def view(self, camera: Camera, enu_from_cam: Rigid3, pixels: Float) -> Hits:
        """Return what a camera sees at pixels (..., 2); as its rays have z = 1, the hit distance is the depth in m."""
        rays = camera.rays(pixels).reshape(-1, 3)
        # Not a matrix product: BLAS would start threads for three columns, and waiting for them costs more.
        directions = np.einsum("ij,nj->ni", enu_from_cam.rotation, rays)
        return self.cast(enu_from_cam.translation, directions)

    def colour(self, hits: Hits, footprint_m: float = 0.0) -> UInt8:
        """Return the colours (N, 3) 0..255 of hits; details smaller than `footprint_m` are left out; sky is blue."""
        faces = hits.faces
        material = self.material[faces]
        material[faces < 0] = -1
        colour = np.full((len(faces), 3), SKY, np.float32)
        for kind in (GROUND, ROOF, WALL, TREE):
            chosen = np.flatnonzero(material == kind)
            if len(chosen):
                a, b = self._texture_coordinates(kind, hits.points[chosen], faces[chosen])
                base = self.base_colour[faces[chosen]] if kind != GROUND else None
                paint = self._paint(kind, a, b, base, footprint_m)
                colour[chosen] = paint * self._light[faces[chosen], None]
        return np.clip(colour, 0.0, 255.0, out=colour).astype(np.uint8)

    def _paint(self, kind: int, a: Float, b: Float, base: Float | None, footprint_m: float) -> Float:
        """Return unlit colours (N, 3) of one material at texture coordinates a, b (N,); the ground has no base."""
        detail = self.texture.detail(a, b, footprint_m)
        if base is None:
            return self.texture.ground(a, b, detail)
        if kind == ROOF:
            return self.texture.roof(a, b, base, detail)
        if kind == WALL:
            return self.texture.wall(a, b, base, detail)
        return np.asarray(base * (1.0 + 2.0 * detail)[:, None])

    def _texture_coordinates(self, kind: int, points: Float, faces: Int) -> tuple[Float, Float]:
        """Return texture coordinates (N,), (N,) in metres of points (N, 3) on triangles (N,) of one material."""
        if kind != GROUND:
            coordinates = np.einsum("nki,ni->nk", self.texture_axes[faces], points) + self.texture_offset[faces]
        else:  # the ground's texture plane is the map itself, but look-alike blocks repeat the first one
            coordinates = points[:, :2]
            for corner in self.blocks[1:]:
                inside = np.all((coordinates >= corner) & (coordinates < corner + BLOCK_SIZE_M), axis=-1)
                coordinates = np.where(inside[:, None], coordinates - corner + self.blocks[0], coordinates)
        return np.asarray(coordinates[:, 0], np.float32), np.asarray(coordinates[:, 1], np.float32)

    def sample_surface(self, count: int, seed: int) -> Hits:
        """Return about `count` random points of the surface that see the sky, evenly spread by area."""
        rng = np.random.default_rng(seed)
        edge_1, edge_2 = self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0]
        area = 0.5 * np.linalg.norm(np.cross(edge_1, edge_2), axis=-1)
        faces = rng.choice(len(area), count, p=area / area.sum())
        s, t = rng.random((2, count, 1))
        s, t = np.where(s + t > 1.0, 1.0 - s, s), np.where(s + t > 1.0, 1.0 - t, t)
        points = self.triangles[faces, 0] + s * edge_1[faces] + t * edge_2[faces]
        up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
        open_sky = self.cast(points + 0.02 * self.normals[faces], up).faces < 0
        faces, points = faces[open_sky], points[open_sky]
        return Hits(np.zeros(len(faces)), points, self.normals[faces], faces)

    @cached_property
    def _triangle_indices(self) -> list[tuple[Float, Any]]:
        """Triangles of similar size with a tree of their centres, for each of ground, houses and crowns."""
        import trimesh
        from scipy.spatial import cKDTree

        indices = []
        for kinds in ((GROUND,), (ROOF, WALL), (TREE,)):
            triangles = self.triangles[np.isin(self.material, kinds)]
            if len(triangles):
                corners = np.arange(3 * len(triangles)).reshape(-1, 3)
                vertices, faces = trimesh.remesh.subdivide_to_size(triangles.reshape(-1, 3), corners, QUERY_EDGE_M)
                triangles = np.asarray(vertices)[faces]
                indices.append((triangles, cKDTree(triangles.mean(axis=1))))
        return indices

    def distance_to_surface(self, points: Float) -> Float:
        """Return the distance (N,) in metres of points (N, 3) to the nearest point of the surface."""
        import trimesh

        points = np.asarray(points, float)
        distances = np.full(len(points), np.inf)
        for triangles, tree in self._triangle_indices:
            for start in range(0, len(points), QUERY_CHUNK):
                chunk = slice(start, start + QUERY_CHUNK)
                _, nearest = tree.query(points[chunk], k=min(NEAREST_TRIANGLES, len(triangles)))
                repeated = np.repeat(points[chunk], nearest.shape[1], axis=0)
                closest = trimesh.triangles.closest_point(triangles[nearest.ravel()], repeated)
                offset = np.linalg.norm(np.asarray(closest) - repeated, axis=-1).reshape(nearest.shape)
                distances[chunk] = np.minimum(distances[chunk], offset.min(axis=1))
        return distances


def make_scene(
    bounds: tuple[float, float, float, float],
    seed: int,
    *,
    look_alike: bool = False,
    hill_height_m: float = 12.0,
    building_spacing_m: float = 38.0,
    tree_spacing_m: float = 17.0,
) -> Scene:
    """Return a landscape over (west, south, east, north) in ENU metres, the same for the same arguments."""
    rng = np.random.default_rng(seed)
    hills = Hills.draw(hill_height_m, rng)
    blocks = place_blocks(bounds) if look_alike else np.zeros((0, 2))
    extent_m = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    ground = ground_patch(hills, bounds, cell_m=max(2.0, extent_m / 600.0))
    patches = [ground, *scatter_objects(hills, bounds, blocks, building_spacing_m, tree_spacing_m, rng)]

    return assemble_scene(patches, hills, bounds, seed, blocks)


def assemble_scene(
    patches: Sequence[Patch],
    hills: Hills,
    bounds: tuple[float, float, float, float],
    seed: int,
    blocks: Float | None = None,
) -> Scene:
    """Return the scene that consists of the given patches; the seed draws its texture."""

    def per_triangle(value: Callable[[Patch], Any], dtype: type) -> Any:
        return np.concatenate([np.repeat(np.asarray(value(p), dtype)[None], len(p.triangles), axis=0) for p in patches])

    return Scene(
        triangles=np.concatenate([p.triangles for p in patches]),
        material=per_triangle(lambda p: p.material, np.int8),
        base_colour=per_triangle(lambda p: p.colour, np.float32),
        texture_axes=per_triangle(lambda p: np.stack([p.axis_u, p.axis_v]), np.float32),
        texture_offset=per_triangle(lambda p: p.offset, np.float32),
        hills=hills,
        blocks=np.zeros((0, 2)) if blocks is None else blocks,
        texture=Texture(seed),
        bounds=bounds,
    )
