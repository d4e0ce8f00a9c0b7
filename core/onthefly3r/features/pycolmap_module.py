"""One place to import pycolmap: what must come before it, and how loud it may be."""

from __future__ import annotations

import zlib  # noqa: F401 - must be loaded before pycolmap, else PNG and deflate writers of this process abort
from functools import lru_cache
from typing import Any

from ..geometry.camera import Camera


@lru_cache(maxsize=1)
def load_pycolmap() -> Any:
    """Return the pycolmap module with its chatter silenced: only errors reach standard error."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR.value)
    return pycolmap


def to_pycolmap_camera(camera: Camera, camera_id: int) -> Any:
    """Return the camera as pycolmap's OPENCV model, its focal length marked as known."""
    pycolmap = load_pycolmap()

    made = pycolmap.Camera(
        model="OPENCV",
        width=camera.width,
        height=camera.height,
        params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
        camera_id=camera_id,
    )
    made.has_prior_focal_length = True
    return made
