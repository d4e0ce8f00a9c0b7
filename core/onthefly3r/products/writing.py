"""The files of a run: cloud, cameras, trajectory, COLMAP model and preview from a finished map."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..cloud.fuse import fuse
from ..earth.georef import world_frame
from ..earth.positions import usable_positions
from ..errors import InputError
from ..geometry.arrays import Float
from ..geometry.geodesy import WorldFrame, wkt1
from ..geometry.transforms import Rigid3, Sim3, nearest_rotation
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..records import CloudTile, GeoReference, PlacedCamera, Rejection, Shot
from .clip import Boundary, clipped, read_boundary
from .colmap import SparsePoints, write_model
from .footprints import Footprint, footprint, with_overlap, write_footprints
from .las import CloudSummary, las_scale_m, write_cloud
from .preview import write_preview
from .rows import CameraRow, placed_row, rejected_row
from .trajectory_table import write_trajectory
from .vector import write_cameras

SPARSE_POINTS_PER_IMAGE = 200


@dataclass(frozen=True)
class ExportFrame:
    """From the map to the coordinates in the files: a projected CRS, or the levelled map itself."""

    level_from_map: Sim3  # to east-north-up metres, or to the levelled map
    world: WorldFrame | None  # None: coordinates stay in the levelled map
    metric: bool = True  # whether the unit is the metre

    @classmethod
    def of(cls, reference: GeoReference | None, up: Float | None, metres_per_map_unit: float | None) -> ExportFrame:
        """Return the frame of a georeference; without one, the map turned so that `up` points up, and scaled."""
        if reference is not None:
            return cls(reference.enu_from_map, world_frame(reference))
        return cls(
            Sim3(metres_per_map_unit or 1.0, _turning_up(up), np.zeros(3)), None, metres_per_map_unit is not None
        )

    @property
    def wkt(self) -> str | None:
        """WKT 1 of the CRS, None without one."""
        return wkt1(self.world.crs, self.world.vertical) if self.world else None

    def points(self, map_points: Float) -> Float:
        """Map points (N, 3) of the map frame."""
        return self.from_level(self.level_from_map.apply(np.asarray(map_points, float)))

    def from_level(self, level_points: Float) -> Float:
        """Map points (N, 3) in metres of the levelled frame."""
        return self.world.from_enu(level_points) if self.world else level_points

    def pose(self, map_from_cam: Rigid3) -> Rigid3:
        """Map a camera pose; the meridian convergence turns the axes of a projected CRS."""
        level = self.level_from_map.apply_to_pose(map_from_cam)
        if self.world is None:
            return level
        turn = self.world.rotation_world_from_enu(level.translation)
        return Rigid3(turn @ level.rotation, self.world.from_enu(level.translation[None])[0])

    def convergence_deg(self, map_from_cam: Rigid3) -> float:
        """Return the angle from true to grid north at a camera, clockwise; 0 without a CRS."""
        if self.world is None:
            return 0.0
        turn = self.world.rotation_world_from_enu(self.level_from_map.apply(map_from_cam.translation))
        return float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))


def remove_products(out: Path) -> None:
    """Remove the files of an earlier result, so that none can pass for one of the next, which may fail."""
    tables = (
        f"{name}.{suffix}" for name in ("cameras", "footprints") for suffix in ("shp", "shx", "dbf", "prj", "cpg")
    )
    model = (f"colmap/{name}.{suffix}" for name in ("cameras", "images", "points3D") for suffix in ("txt", "bin"))
    single = ("cloud.las", "cloud.laz", "trajectory.csv", "preview.png", "report.json", "report.html")
    for name in (*single, *tables, *model):
        (out / name).unlink(missing_ok=True)


def write_products(
    out: Path,
    work: Path,
    state: MapState,
    store: Store,
    shots: Mapping[int, Shot],
    rejections: Mapping[int, Rejection],
    retries: Mapping[int, int],
    reference: GeoReference | None,
    frame: ExportFrame,
    options: Options,
    title: str,
    checkpoint: Callable[[str, int, int], None],
) -> CloudSummary | None:
    """Write all files but the report into `out` and return the cloud's summary, None when none is asked for.

    Raises `ReconstructionError` when the cloud has no points.
    """
    cameras = placed_cameras(state, shots, retries, frame)
    rows = camera_rows(cameras, state, shots, rejections, retries, reference, frame, options)
    cloud = _write_cloud(out, work, state, store, len(shots), reference, frame, options, title, checkpoint)
    write_cameras(out / "cameras.shp", rows, reference.crs if reference else None)
    write_footprints(out / "footprints.shp", footprints(cameras, state, frame), reference.crs if reference else None)
    write_trajectory(out / "trajectory.csv", rows)
    write_model(out / "colmap", cameras, _sparse_points(state, frame))
    if cloud is not None:
        unit = "m" if frame.metric else "map units"
        write_preview(out / "preview.png", cloud, rows, title, georeferenced=reference is not None, unit=unit)
    return cloud


def _write_cloud(
    out: Path,
    work: Path,
    state: MapState,
    store: Store,
    n_images: int,
    reference: GeoReference | None,
    frame: ExportFrame,
    options: Options,
    title: str,
    checkpoint: Callable[[str, int, int], None],
) -> CloudSummary | None:
    """Fuse and write the cloud in the format that is asked for, without leaving an earlier one beside it."""
    if not options.export.cloud:
        for stale in ("cloud.las", "cloud.laz", "preview.png"):
            (out / stale).unlink(missing_ok=True)
        return None
    spacing_m = options.export.spacing_m or frame.level_from_map.scale * state.spacing
    fused = fuse(
        _cloud(state, store, frame, checkpoint),
        spacing_m,
        options.export.min_confidence,
        work / "fusion",
        options.export.stray_filter,
        lambda done, total: checkpoint("fusing the cloud", done, total),
        options.backbone.threads or os.cpu_count() or 1,
    )
    # Fused before it is projected: a fifth of the points are left then.
    tiles: Iterator[CloudTile] = (replace(tile, points=frame.from_level(tile.points)) for tile in fused)
    if options.export.boundary is not None:
        tiles = clipped(tiles, _boundary(Path(options.export.boundary), reference))
    name = f"cloud.{options.export.format}"
    cloud = write_cloud(out / name, tiles, frame.wkt, las_scale_m(spacing_m), title, n_images=n_images)
    for other in {"cloud.las", "cloud.laz"} - {name}:
        (out / other).unlink(missing_ok=True)
    return cloud


def placed_cameras(
    state: MapState, shots: Mapping[int, Shot], retries: Mapping[int, int], frame: ExportFrame
) -> list[PlacedCamera]:
    """Return the accepted cameras in the export frame, at photograph size, in the order of the shots."""
    placed = []
    for index in sorted(state.frames):
        shot, stored = shots[index], state.frames[index]
        placed.append(
            PlacedCamera(
                index=index,
                name=shot.name,
                camera=state.calibrations.get(shot.camera_key)
                or stored.camera.through(stored.grid_from_photo.inverse(), shot.width_px, shot.height_px),
                world_from_cam=frame.pose(state.map_from_cam(index)),
                batch=stored.submap,
                retries=retries.get(index, 0),
            )
        )
    return placed


def footprints(cameras: list[PlacedCamera], state: MapState, frame: ExportFrame) -> list[Footprint]:
    """Return what the cameras cover, each on the plane at the median height of the points that it sees."""
    found = []
    for camera in cameras:
        points = state.submap_pose_of(camera.index).apply(state.reference(camera.index).points.astype(float))
        if len(points):
            found.append(footprint(camera, float(np.median(frame.points(points)[:, 2]))))
    return with_overlap([item for item in found if item is not None])


def camera_rows(
    cameras: list[PlacedCamera],
    state: MapState,
    shots: Mapping[int, Shot],
    rejections: Mapping[int, Rejection],
    retries: Mapping[int, int],
    reference: GeoReference | None,
    frame: ExportFrame,
    options: Options,
) -> list[CameraRow]:
    """Return one row per photograph, placed ones first, both in capture order, whatever order the shots came in.

    Tagged positions are in the export frame.
    """
    tagged = _tagged_positions(shots, frame, options) if reference else {}
    rows = []
    for camera in sorted(cameras, key=lambda camera: shots[camera.index].capture_order):
        position, sigma_h_m, sigma_v_m = tagged.get(camera.index, (None, None, None))
        rows.append(
            placed_row(
                camera,
                shots[camera.index],
                gps=position,
                sigma_h_m=sigma_h_m,
                sigma_v_m=sigma_v_m,
                used=bool(reference and camera.index in reference.residuals_m),
                convergence_deg=frame.convergence_deg(state.map_from_cam(camera.index)),
            )
        )
    for index in sorted(rejections, key=lambda index: shots[index].capture_order):
        position = tagged.get(index, (None,))[0]
        reason, tries = rejections[index].reason, retries.get(index, 0)
        rows.append(rejected_row(shots[index], index + 1, reason, gps=position, retries=tries))
    return rows


Tagged = tuple[tuple[float, float, float], float, float]  # position in the export frame, sigmas in m


def _tagged_positions(shots: Mapping[int, Shot], frame: ExportFrame, options: Options) -> dict[int, Tagged]:
    positions = usable_positions(sorted(shots), shots, options.georeference)
    if frame.world is None or not positions.images:
        return {}
    world = WorldFrame(frame.world.crs, frame.world.vertical, positions.frame).from_enu(positions.enu)
    return {
        index: ((float(x), float(y), float(z)), float(h), float(v))
        for index, (x, y, z), h, v in zip(
            positions.images, world, positions.sigma_h_m, positions.sigma_v_m, strict=True
        )
    }


def _cloud(
    state: MapState, store: Store, frame: ExportFrame, checkpoint: Callable[[str, int, int], None]
) -> Iterator[CloudTile]:
    for done, stored in enumerate(store.stream_points(), start=1):
        checkpoint("collecting points", done, len(state.frames))
        count = len(stored.points)
        if count == 0:
            continue
        yield CloudTile(
            points=(frame.level_from_map @ state.submap_pose_of(stored.index)).apply(stored.points.astype(float)),
            rgb=stored.rgb,
            confidence=stored.confidence.astype(np.float32) / np.float32(255.0),
            source=np.full(count, stored.index, np.int32),
            batch=np.full(count, stored.submap, np.int32),
            views=np.ones(count, np.int32),
        )


def _boundary(path: Path, reference: GeoReference | None) -> Boundary:
    if reference is None:
        raise InputError("a boundary needs a georeferenced cloud: leave out --local or the boundary")
    return read_boundary(path, reference.crs)


def _sparse_points(state: MapState, frame: ExportFrame) -> SparsePoints:
    """Some compact reference points of every frame, each seen by the image that it belongs to."""
    points, images, pixels = [], [], []
    for index, stored in sorted(state.frames.items()):
        reference = state.reference(index)
        best = np.argsort(-reference.confidence, kind="stable")[:SPARSE_POINTS_PER_IMAGE]
        mapped = state.submap_pose_of(index).apply(reference.points[best].astype(float))
        points.append(frame.points(mapped))
        images.append(np.full(len(best), index))
        pixels.append(stored.grid_from_photo.inverse().apply(reference.pixels[best] + 0.5))
    joined = np.vstack(points)
    return SparsePoints(
        points=joined,
        rgb=np.full((len(joined), 3), 128, np.uint8),
        error_px=np.zeros(len(joined)),
        point=np.arange(len(joined)),
        image=np.concatenate(images),
        pixels=np.vstack(pixels),
    )


def _turning_up(up: Float | None) -> Float:
    """Return the shortest rotation that brings `up` to the third axis."""
    if up is None:
        return np.eye(3)
    third = np.asarray(up, float) / np.linalg.norm(up)
    first = np.eye(3)[int(np.argmin(np.abs(third)))]
    first = first - (first @ third) * third
    first = first / np.linalg.norm(first)
    return nearest_rotation(np.stack([first, np.cross(third, first), third]))
