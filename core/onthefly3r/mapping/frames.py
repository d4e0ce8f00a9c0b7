"""From a view of a validated local model to what the map keeps of it (Eq. 2, Eq. 3)."""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import UInt8
from ..records import Frame, LocalView, NewFrame, WorkingImage
from ..registration.references import compact_reference


def new_frame(
    index: int, submap: int, view: LocalView, image: WorkingImage, min_confidence: float, reference_points: int
) -> NewFrame:
    """Return pose, compact reference and coloured confident points of one image, in the frame of its submap."""
    rows, columns = np.nonzero((view.confidence >= min_confidence) & np.isfinite(view.points).all(axis=-1))
    rgb = colours_at_grid(view, image)
    return NewFrame(
        frame=Frame(index, submap, view.camera, view.grid_from_photo, view.local_from_cam),
        reference=compact_reference(view, reference_points, min_confidence),
        points=view.points[rows, columns].astype(np.float32),
        rgb=rgb[rows, columns],
        confidence=np.rint(255.0 * view.confidence[rows, columns]).astype(np.uint8),
    )


def colours_at_grid(view: LocalView, image: WorkingImage) -> UInt8:
    """Return the colour (H, W, 3) of every pixel of the point map."""
    import cv2

    height, width = view.confidence.shape
    working_from_grid = image.working_from_photo.apply(
        view.grid_from_photo.inverse().apply(view.camera.pixel_centres().reshape(-1, 2))
    ).reshape(height, width, 2)
    # OpenCV counts from the centre of the first pixel, we from its corner.
    at = (working_from_grid - 0.5).astype(np.float32)
    sampled = cv2.remap(image.rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, np.uint8)
