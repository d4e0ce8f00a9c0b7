"""Look at a point cloud in a window of open3d (extra `cloud`)."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..evaluate.clouds import open_cloud
from ..evaluate.icp import import_open3d

MOST_POINTS = 20_000_000


def view_cloud(path: Path) -> None:
    """Open a window with a LAS or LAZ cloud, or the cloud of a result folder, and return when it is closed.

    Raises `InputError` when there is no such cloud, or no screen, and `MissingDependencyError` without open3d.
    """
    path = open_cloud(path).path
    # open3d would render into an invisible window and never come back.
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("there is no screen to show the cloud on: DISPLAY and WAYLAND_DISPLAY are not set")
    open3d = import_open3d()
    import laspy

    try:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            # An even step through the file keeps the whole area in sight.
            cloud = reader.read().points[:: 1 + reader.header.point_count // MOST_POINTS]
    except laspy.errors.LaspyException as error:
        raise InputError(f"{path} is not a LAS or LAZ cloud: {error}") from error
    centre = np.round(np.array([np.mean(cloud.x), np.mean(cloud.y), np.mean(cloud.z)]))
    shown = open3d.geometry.PointCloud()
    # Single-precision graphics cannot show metres in UTM: the window's origin is the middle of the cloud.
    shown.points = open3d.utility.Vector3dVector(np.column_stack([cloud.x, cloud.y, cloud.z]) - centre)
    shown.colors = open3d.utility.Vector3dVector(np.column_stack([cloud.red, cloud.green, cloud.blue]) / 65535.0)
    window = open3d.visualization.Visualizer()
    if not window.create_window(window_name=path.name):
        raise InputError("open3d could not open a window: this needs a screen with OpenGL")
    window.add_geometry(shown)
    window.run()
    window.destroy_window()
