"""From what 3R networks answer to the one `LocalModel`: network images, cameras, confidence, views.

Networks count pixels from centre to centre or from corner to corner; here (u + 0.5, v + 0.5) is the centre of
the pixel in row v, column u, so the middle of a W x H image is (W / 2, H / 2) whatever the network calls it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.arrays import Bool, Float, UInt8
from ..geometry.camera import Camera, PixelMap
from ..geometry.transforms import Rigid3, nearest_rotation
from ..records import LocalView, WorkingImage

MIN_FOV_RAD, MAX_FOV_RAD = 0.02, 3.1  # outside of these a predicted field of view is no camera


@dataclass(frozen=True)
class NetworkImage:
    """One photograph as a network wants it."""

    rgb: UInt8  # (H, W, 3)
    grid_from_photo: PixelMap  # from the upright photograph to this image's pixels


@dataclass(frozen=True)
class Canvas:
    """The images of a subset on one common size; smaller ones lie centred on white."""

    rgb: Float  # (S, H, W, 3) float32 in 0..1
    windows: tuple[tuple[int, int, int, int], ...]  # per image: top, left, height, width
    maps: tuple[PixelMap, ...]  # per image: grid_from_photo of its window

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return int(self.rgb.shape[1]), int(self.rgb.shape[2])


@dataclass(frozen=True)
class Prediction:
    """What a network says of a canvas of S images, in our conventions."""

    local_from_cam: Float  # (S, 3 or 4, 4)
    points_cam: Float  # (S, H, W, 3) camera frame; NaN where masked
    confidence: Float  # (S, H, W) in 0..1
    intrinsics: Float | None  # (S, 4) fx, fy, cx, cy in px of the canvas; None fits the focal lengths to the points
    tokens: Float | None = None  # (S, D)
    metric: bool = False


def network_image(
    image: WorkingImage, width: int, height: int, resample: str, box: tuple[float, float, float, float] | None = None
) -> NetworkImage:
    """Cut `box` (left, top, right, bottom in working pixels) out of an image and resample it to width x height.

    `resample` is LANCZOS or BICUBIC as Pillow has them, or AREA as OpenCV has it, for whole images.
    """
    rows, columns = image.rgb.shape[:2]
    left, top, right, bottom = box or (0.0, 0.0, float(columns), float(rows))
    if resample == "AREA":
        import cv2

        resized = cv2.resize(image.rgb, (width, height), interpolation=cv2.INTER_AREA)
    else:
        from PIL import Image

        pillow = Image.fromarray(np.ascontiguousarray(image.rgb))
        resized = np.asarray(pillow.resize((width, height), Image.Resampling[resample], (left, top, right, bottom)))
    scale_x, scale_y = width / (right - left), height / (bottom - top)
    photo = image.working_from_photo
    grid_from_photo = PixelMap(
        scale_x * photo.scale_x,
        scale_y * photo.scale_y,
        scale_x * (photo.offset_x - left),
        scale_y * (photo.offset_y - top),
    )
    return NetworkImage(np.asarray(resized, np.uint8), grid_from_photo)


def centred_box(image: WorkingImage, aspect: float) -> tuple[float, float, float, float]:
    """Return the largest centred box of an image with the given width / height, in working pixels."""
    rows, columns = image.rgb.shape[:2]
    width, height = min(columns, rows * aspect), min(rows, columns / aspect)
    left, top = 0.5 * (columns - width), 0.5 * (rows - height)
    return left, top, left + width, top + height


def compose(images: Sequence[NetworkImage]) -> Canvas:
    """Put images of any sizes on one canvas, as 3R networks take one size only."""
    height = max(image.rgb.shape[0] for image in images)
    width = max(image.rgb.shape[1] for image in images)
    rgb = np.ones((len(images), height, width, 3), np.float32)
    windows = []
    for number, image in enumerate(images):
        rows, columns = image.rgb.shape[:2]
        top, left = (height - rows) // 2, (width - columns) // 2
        rgb[number, top : top + rows, left : left + columns] = image.rgb.astype(np.float32) / 255.0
        windows.append((top, left, rows, columns))
    return Canvas(rgb, tuple(windows), tuple(image.grid_from_photo for image in images))


def confidence_from_logit(logit: Float) -> Float:
    """Return the logistic function of a raw confidence (Pi3), 0..1."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * np.asarray(logit, np.float64))))


def confidence_from_one_plus_exp(raw: Float) -> Float:
    """Return 1 - 1/c of a confidence c = 1 + exp(x), which is the logistic function of x."""
    return np.asarray(1.0 - 1.0 / np.maximum(np.asarray(raw, np.float64), 1.0))


def rigid_inverse(matrices: Float) -> Float:
    """Invert rigid matrices (S, 3 or 4, 4), e.g. camera <- world to world <- camera; returns (S, 3, 4)."""
    rotation = np.swapaxes(np.asarray(matrices, float)[:, :3, :3], 1, 2)
    translation = -np.einsum("sij,sj->si", rotation, np.asarray(matrices, float)[:, :3, 3])
    return np.concatenate([rotation, translation[:, :, None]], axis=2)


def decode_pose(encoding: Float, height: int, width: int) -> tuple[Float, Float]:
    """Decode (S, 9) of translation, quaternion xyzw and field of view (h, w) in rad (VGGT, VGGT-Omega).

    Returns camera <- world (S, 3, 4) and (fx, fy, cx, cy) in px (S, 4); no camera gives NaN.
    """
    encoding = np.asarray(encoding, float)
    x, y, z, w = np.moveaxis(encoding[:, 3:7] / np.linalg.norm(encoding[:, 3:7], axis=1, keepdims=True), 1, 0)
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=-1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=-1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=1,
    )
    fov = encoding[:, 7:9]
    fov = np.where((fov > MIN_FOV_RAD) & (fov < MAX_FOV_RAD), fov, np.nan)
    focal = 0.5 * np.array([height, width]) / np.tan(0.5 * fov)
    centre = np.broadcast_to([0.5 * width, 0.5 * height], focal.shape)
    return np.concatenate([rotation, encoding[:, :3, None]], axis=2), np.concatenate([focal[:, ::-1], centre], axis=1)


def unproject(depth: Float, intrinsics: Float) -> Float:
    """Return camera-frame points (S, H, W, 3) of z-depths (S, H, W) with (fx, fy, cx, cy) per image (S, 4)."""
    depth = np.asarray(depth, float)
    height, width = depth.shape[1:]
    u, v = np.arange(width) + 0.5, np.arange(height) + 0.5
    fx, fy, cx, cy = (column[:, None, None] for column in np.moveaxis(np.asarray(intrinsics, float), 1, 0))
    return np.stack([(u[None, None, :] - cx) / fx * depth, (v[None, :, None] - cy) / fy * depth, depth], axis=-1)


def fit_focal(points_cam: Float, weight: Float, cx: float, cy: float) -> tuple[float, float]:
    """Return (fx, fy) in px by least squares on camera-frame points (H, W, 3), the principal point being given.

    `weight` (H, W) is 0 for points that must not count.
    """
    rows, columns = points_cam.shape[:2]
    good = weight > 0.0
    u, v = np.meshgrid(np.arange(columns) + 0.5 - cx, np.arange(rows) + 0.5 - cy)
    x, y = (points_cam[good, axis] / points_cam[good, 2] for axis in (0, 1))
    w = weight[good]
    with np.errstate(divide="ignore", invalid="ignore"):
        fx, fy = np.sum(w * x * u[good]) / np.sum(w * x * x), np.sum(w * y * v[good]) / np.sum(w * y * y)
    return float(fx), float(fy)


def local_views(members: Sequence[int], canvas: Canvas, prediction: Prediction) -> dict[int, LocalView]:
    """Return the views of a prediction by shot index; images without a usable camera are left out."""
    views = {}
    for number, index in enumerate(members):
        view = _local_view(number, canvas, prediction)
        if view is not None:
            views[index] = view
    return views


def median_calibrations(
    views: Mapping[int, LocalView], images: Mapping[int, WorkingImage], known: Mapping[str, Camera]
) -> dict[str, Camera]:
    """Return the median intrinsics at photograph size of every camera key that is not known yet."""
    by_key: dict[str, list[Camera]] = {}
    for index, view in views.items():
        shot = images[index].shot
        if shot.camera_key not in known:
            camera = view.camera.through(view.grid_from_photo.inverse(), shot.width_px, shot.height_px)
            by_key.setdefault(shot.camera_key, []).append(camera)
    return {key: _median_camera(cameras) for key, cameras in by_key.items()}


def _median_camera(cameras: Sequence[Camera]) -> Camera:
    fx, fy, cx, cy = np.median([(c.fx, c.fy, c.cx, c.cy) for c in cameras], axis=0)
    return Camera(cameras[0].width, cameras[0].height, float(fx), float(fy), float(cx), float(cy))


def _local_view(number: int, canvas: Canvas, prediction: Prediction) -> LocalView | None:
    top, left, rows, columns = canvas.windows[number]
    window = (number, slice(top, top + rows), slice(left, left + columns))
    points_cam = np.asarray(prediction.points_cam[window], float)
    confidence = np.asarray(prediction.confidence[window], float)
    known = np.isfinite(points_cam).all(axis=-1) & (points_cam[..., 2] > 0.0) & np.isfinite(confidence)
    confidence = np.where(known, confidence, 0.0)
    camera = _camera(number, canvas, prediction, points_cam, confidence)
    pose = np.asarray(prediction.local_from_cam[number], float)[:3]
    if camera is None or not np.isfinite(pose).all() or not known.any():
        return None
    local_from_cam = Rigid3(nearest_rotation(pose[:, :3]), pose[:, 3])
    return LocalView(
        camera=camera,
        grid_from_photo=canvas.maps[number],
        local_from_cam=local_from_cam,
        points=_masked(local_from_cam.apply(points_cam), known),
        confidence=confidence.astype(np.float32),
        tokens=None if prediction.tokens is None else np.asarray(prediction.tokens[number], np.float32),
    )


def _camera(number: int, canvas: Canvas, prediction: Prediction, points_cam: Float, confidence: Float) -> Camera | None:
    top, left, rows, columns = canvas.windows[number]
    height, width = canvas.size
    if prediction.intrinsics is None:
        cx, cy = 0.5 * width - left, 0.5 * height - top
        fx, fy = fit_focal(points_cam, confidence, cx, cy)
    else:
        fx, fy, cx, cy = (float(value) for value in prediction.intrinsics[number])
        cx, cy = cx - left, cy - top
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0.0 and fy > 0.0):
        return None
    return Camera(columns, rows, fx, fy, cx, cy)


def _masked(points: Float, known: Bool) -> Float:
    return np.where(known[..., None], points, np.nan).astype(np.float32)
