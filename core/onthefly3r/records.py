"""What the stages hand to each other: frozen records, array fields with shape, frame and unit.

GpsFix, Attitude -> Shot -> WorkingImage -> Features -> Descriptor
-> Subset -> LocalModel -> Correspondences -> Alignment | Rejection -> Submap, Sighting -> GeoReference
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, Protocol

from .geometry.arrays import Bool, Float, Int, UInt8
from .geometry.camera import Camera, PixelMap
from .geometry.transforms import Rigid3, Sim3

VerticalReference = Literal["ellipsoidal", "egm96", "egm2008", "relative", "unknown"]


@dataclass(frozen=True)
class GpsFix:
    """A position from the tags; sigma is None where the tags do not state it."""

    lat_deg: float  # WGS 84
    lon_deg: float
    height_m: float | None  # in `vertical`
    vertical: VerticalReference = "unknown"
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    rtk: int | None = None  # DJI RtkFlag: 0 none, 16 single, 32-49 float, 50 fixed


@dataclass(frozen=True)
class Attitude:
    """Gimbal angles: yaw from true north clockwise, pitch -90 at nadir, roll about the viewing axis."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True)
class Shot:
    """One photograph before its pixels are used; sizes are those of the decoded, upright image."""

    name: str  # path relative to the given folder, posix style: unique
    path: Path
    width_px: int
    height_px: int
    camera_key: str  # maker, model, lens, size: shots with the same key share intrinsics
    focal_ratio: float  # prior focal length / longest side
    focal_ratio_sigma: float  # relative standard deviation of that prior (0.05 = 5 %)
    focal_source: str  # "exif+sensor", "exif 35 mm", "guess", "option"
    time_s: float | None = None  # capture time, seconds since 1970 in the camera's own clock
    orientation: int = 1  # EXIF orientation of the file; the decoded image is upright
    gps: GpsFix | None = None
    attitude: Attitude | None = None
    above_takeoff_m: float | None = None  # flying height that the drone states
    deep: bool = False  # more than 8 bits per channel
    value_range: tuple[float, float] | None = None  # of the flight's deep pixels: what becomes black and white
    stamp: tuple[int, int] | None = None  # size in bytes and time of change (ns) of the file when its tags were read
    positions_from_file: bool = False  # `gps` and `attitude` are a position file's
    warnings: tuple[str, ...] = ()

    @property
    def capture_order(self) -> tuple[float, str]:
        """What sorts shots by capture time then name; those without a time come last."""
        return math.inf if self.time_s is None else self.time_s, self.name


@dataclass(frozen=True)
class RefusedPhotograph:
    """A file that never became a shot: named, because it has no index."""

    name: str  # path relative to the given folder, posix style
    reason: str
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class WorkingImage:
    """A shot's pixels at working size, upright RGB."""

    shot: Shot
    rgb: UInt8  # (H, W, 3)
    working_from_photo: PixelMap

    @property
    def prior_camera(self) -> Camera:
        """The camera that the tags suggest, at working size, without distortion."""
        height, width = self.rgb.shape[:2]
        focal = self.shot.focal_ratio * max(self.shot.width_px, self.shot.height_px)
        photo = Camera(
            self.shot.width_px, self.shot.height_px, focal, focal, self.shot.width_px / 2, self.shot.height_px / 2
        )
        return photo.through(self.working_from_photo, width, height)


@dataclass(frozen=True)
class Features:
    """Local features of one working image."""

    pixels: Float  # (N, 2) float32, working image
    scales: Float  # (N,) float32 px
    angles: Float  # (N,) float32 rad
    descriptors: UInt8  # (N, 128) RootSIFT


@dataclass(frozen=True)
class Neighbour:
    """A retrieved frame and its cosine similarity."""

    index: int
    similarity: float


@dataclass(frozen=True)
class Subset:
    """What one backbone call sees (Eq. 8): references that are in the map, and new images; indices of shots."""

    references: tuple[int, ...]
    new: tuple[int, ...]
    # How hard to try: 0 at first, 1 and more where an easier try found too little. A backbone may take more features,
    # larger images and more starts then; it may also not care.
    effort: int = 0

    @property
    def members(self) -> tuple[int, ...]:
        """References first, then new images."""
        return self.references + self.new


@dataclass(frozen=True)
class LocalView:
    """One image of a local model; the point map may be smaller than the working image."""

    camera: Camera  # intrinsics at the size of the point map
    grid_from_photo: PixelMap  # from the upright photograph to the point map's pixels
    local_from_cam: Rigid3
    points: Float  # (H, W, 3) float32, local frame; NaN where nothing is known
    confidence: Float  # (H, W) float32 in 0..1; 0 where points are NaN
    tokens: Float | None = None  # (D,) context token of a neural backbone
    # (H, W) pixels that hold a point in every local model that places the image; None where all pixels do.
    recurring: Bool | None = None


@dataclass(frozen=True)
class Observations:
    """Which features of which images a local model saw as one point."""

    image: Int  # (M,) shot index
    feature: Int  # (M,) index among the local features of the image, the same in every subset
    pixel: Float  # (M, 2) float32, upright photograph
    point: Int  # (M,) row of points
    points: Float  # (N, 3) float32, local frame


@dataclass(frozen=True)
class LocalModel:
    """Phi(f(subset)) (Eq. 1, Eq. 9): views by shot index in one arbitrary local frame; failed images are missing."""

    views: Mapping[int, LocalView]
    metric: bool = False  # local units are metres
    calibrations: Mapping[str, Camera] = field(default_factory=dict)  # per camera key, photograph size
    observations: Observations | None = None  # of a backbone that matches features
    notes: Mapping[str, float] = field(default_factory=dict)  # figures for the report
    left_out: tuple[int, ...] = ()  # new images that memory had no room for: not looked at, to be asked for again


@dataclass(frozen=True)
class Correspondences:
    """Pairs of local and map points of the references (Eq. 10)."""

    local: Float  # (N, 3) local frame
    map: Float  # (N, 3) map frame
    weight: Float  # (N,)
    reference: Float  # (N,) shot index of the reference each pair comes from


@dataclass(frozen=True)
class Alignment:
    """The Sim(3) of a subset to the map (Eq. 11) and how well it is known."""

    map_from_local: Sim3
    covariance: Float  # (7, 7) of [rotation rad, translation, log scale], right perturbation in the local frame
    inlier_ratio: float
    residual: float  # robust standard deviation of the residuals, map units
    n_points: int
    references: tuple[int, ...]


@dataclass(frozen=True)
class Rejection:
    """A local model that did not fit: an ordinary outcome, with numbers."""

    images: tuple[int, ...]
    stage: str  # intake, retrieval, seed, backbone, alignment, references, queries
    reason: str
    numbers: Mapping[str, float] = field(default_factory=dict)
    neighbours: Mapping[int, str] = field(default_factory=dict)  # references that were looked at: why each did not do


@dataclass(frozen=True)
class CompactReference:
    """H_i (Eq. 2): a few confident points of one accepted frame, spread over the image."""

    pixels: Float  # (P, 2) int32 column, row in the point map
    points: Float  # (P, 3) float32, frame of the submap that predicted them
    confidence: Float  # (P,) float32


@dataclass(frozen=True)
class Frame:
    """F_i (Eq. 3): an accepted image; its pose lives in the frame of the submap that predicted it."""

    index: int
    submap: int
    camera: Camera
    grid_from_photo: PixelMap
    submap_from_cam: Rigid3
    depth: float  # of its points along the optical axis, median; units of the submap; 0 where none is known


@dataclass(frozen=True)
class Edge:
    """A measured Sim(3) between two nodes of a pose graph."""

    source: int
    target: int
    source_from_target: Sim3
    covariance: Float  # (7, 7) [rotation rad, translation, log scale], right perturbation in the target frame


@dataclass(frozen=True)
class Sighting:
    """A placed frame as a later submap saw it again: the references of a subset are inferred anew."""

    frame: int  # shot index
    submap: int  # that saw it again
    frame_from_submap: Sim3  # to the frame in which the points of `frame` are stored, that of its own submap
    submap_from_cam: Rigid3


@dataclass(frozen=True)
class FrameEdge:
    """A measured relative pose between two frames (Eq. 15), for the paper's SE(3) graph."""

    source: int  # shot index
    target: int  # shot index
    source_from_target: Rigid3  # translation in map units
    sigma_rotation_rad: float
    sigma_translation: float  # map units
    kind: Literal["ref", "batch", "cont"]


@dataclass(frozen=True)
class NewFrame:
    """An image of a local model on its way into the map: everything that is stored of it."""

    frame: Frame
    reference: CompactReference
    points: Float  # (N, 3) float32, submap frame
    rgb: UInt8  # (N, 3)
    confidence: UInt8  # (N,) 0..255


@dataclass(frozen=True)
class Submap:
    """One committed local model: its new frames, and how it saw its references."""

    number: int
    map_from_submap: Sim3
    frames: tuple[Frame, ...]
    sightings: tuple[Sighting, ...]
    frame_edges: tuple[FrameEdge, ...] = ()
    calibrations: Mapping[str, Camera] = field(default_factory=dict)  # first seen here; per camera key, photograph size
    metric: bool = False  # the local model's units are metres
    fragment: int = 0  # of the map, named by the number of its first submap: `map_from_submap` is in its frame


class PlacedMap(Protocol):
    """What stages that only read the map see of it: accepted frames, their poses and their compact references."""

    @property
    def spacing(self) -> float:
        """l_scene, map units."""
        ...

    @property
    def frames(self) -> Mapping[int, Frame]:
        """Accepted frames by shot index, in the order of their acceptance."""
        ...

    @property
    def map_from_submap(self) -> Mapping[int, Sim3]:
        """Poses of the submaps by number."""
        ...

    @property
    def calibrations(self) -> Mapping[str, Camera]:
        """Intrinsics by camera key, photograph size."""
        ...

    def map_from_cam(self, index: int) -> Rigid3:
        """Return the pose of an accepted frame."""
        ...

    def submap_pose_of(self, index: int) -> Sim3:
        """Return map_from_submap as it holds for one frame."""
        ...

    def reference(self, index: int) -> CompactReference:
        """Return H_i of an accepted frame, in the frame of its submap."""
        ...

    def next_submap(self) -> int:
        """Return the number that the next committed batch gets."""
        ...

    def last_accepted(self, count: int) -> list[int]:
        """Return the last frames of A_k in the order of their acceptance."""
        ...


@dataclass(frozen=True)
class CameraDeviation:
    """Standard deviations of an adjusted camera in the frame of the Earth."""

    h_m: float  # per horizontal axis
    v_m: float
    angle_deg: float  # per axis


@dataclass(frozen=True)
class ControlResidual:
    """A control point or checkpoint: where its marks meet in the adjusted cameras minus its coordinates."""

    label: str
    role: Literal["control", "checkpoint", "left out"]
    images: int  # with a mark that counts
    east_m: float
    north_m: float
    up_m: float  # NaN where the point has no height
    sigma_h_m: float  # of the place found, per horizontal axis
    sigma_v_m: float
    marks_px: float  # root mean square misfit of its marks
    enu_m: tuple[float, float, float]  # its coordinates in local east-north-up


@dataclass(frozen=True)
class EarthTie:
    """How an adjusted map lies on the Earth, and how well it is known."""

    enu_from_map: Sim3
    origin_lat_deg: float
    origin_lon_deg: float
    origin_height_m: float
    by_control: bool  # control took part; else positions alone, which may be fitted anew
    crs: str | None  # that of the control
    vertical: VerticalReference
    deviations: Mapping[int, CameraDeviation] = field(default_factory=dict)  # by shot index
    control: tuple[ControlResidual, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class GeoReference:
    """The map tied to the Earth: local ENU about an origin, and the CRS of the export."""

    enu_from_map: Sim3
    origin_lat_deg: float
    origin_lon_deg: float
    origin_height_m: float
    crs: str  # e.g. EPSG:32633
    vertical: VerticalReference
    method: str
    n_used: int
    n_outliers: int
    rmse_h_m: float
    rmse_v_m: float
    residuals_m: Mapping[int, tuple[float, float, float]] = field(default_factory=dict)  # shot -> east, north, up
    warnings: tuple[str, ...] = ()
    deviations: Mapping[int, CameraDeviation] = field(default_factory=dict)  # by shot index
    control: tuple[ControlResidual, ...] = ()


@dataclass(frozen=True)
class PlacedCamera:
    """A camera in the export frame (projected CRS, or metres of the map when local)."""

    index: int
    name: str
    camera: Camera  # at the size of the photograph
    world_from_cam: Rigid3
    batch: int
    retries: int = 0
    part: int = 1  # of the map, the largest first; what nothing connects lies in different parts


@dataclass(frozen=True)
class CloudTile:
    """A piece of the fused cloud in the export frame."""

    points: Float  # (N, 3) float64, export CRS, m
    rgb: UInt8  # (N, 3)
    confidence: Float  # (N,) float32 0..1
    source: Float  # (N,) int32 shot index of the strongest observation
    batch: Float  # (N,) int32
    views: Float  # (N,) int32 number of images that saw the voxel
    classification: UInt8 | None = None  # (N,) ASPRS classes: 1 unclassified, 2 ground, 7 noise; None: not classified

    def only(self, kept: Bool) -> CloudTile:
        """Return the points that are kept, (N,) truth values."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(self, **{name: values[kept] for name, values in arrays.items() if values is not None})
