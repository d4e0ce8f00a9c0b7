"""From a view of a validated local model to what the map keeps of it (Eq. 2, Eq. 3)."""

from __future__ import annotations

import numpy as np

from ..geometry.arrays import UInt8
from ..records import Frame, LocalView, NewFrame, WorkingImage
from ..registration.references import compact_reference, trusted_pixels


def new_frame(
    index: int, submap: int, view: LocalView, image: WorkingImage, min_confidence: float, reference_points: int
) -> NewFrame:
    """Return pose, compact reference and coloured confident points of one image, in the frame of its submap."""
    kept = trusted_pixels(view, min_confidence)
    rgb = colours_at_grid(view, image)
    reference = compact_reference(view, reference_points, min_confidence)
    depths = view.local_from_cam.inverse().apply(reference.points)[:, 2]
    return NewFrame(
        frame=Frame(
            index,
            submap,
            view.camera,
            view.grid_from_photo,
            view.local_from_cam,
            float(np.median(depths)) if len(depths) else 0.0,
        ),
        reference=reference,
        points=view.points[kept].astype(np.float32),
        rgb=rgb[kept],
        confidence=np.rint(255.0 * view.confidence[kept]).astype(np.uint8),
    )


def colours_at_grid(view: LocalView, image: WorkingImage) -> UInt8:
    """Return the colour (H, W, 3) of every pixel of the point map."""
    import cv2

    height, width = view.confidence.shape
    # Both maps keep the axes apart, so two pixels tell where all are.
    two = np.array([[0.5, 0.5], [1.5, 1.5]])
    # OpenCV counts from the centre of the first pixel, we from its corner.
    first, second = image.working_from_photo.apply(view.grid_from_photo.inverse().apply(two)) - 0.5
    working_from_grid = np.column_stack([np.diag(second - first), first])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sampled = cv2.warpAffine(image.rgb, working_from_grid, (width, height), flags=how, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, np.uint8)
