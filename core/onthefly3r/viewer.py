"""Look at a point cloud in a window of open3d (extra `cloud`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .errors import InputError, MissingDependencyError

MOST_POINTS = 20_000_000


def view_cloud(path: Path) -> None:
    """Open a window with a LAS or LAZ cloud, or the cloud of a result folder, and return when it is closed.

    Raises `InputError` when there is no such cloud, or no screen, and `MissingDependencyError` without open3d.
    """
    if path.is_dir():
        clouds = [path / name for name in ("cloud.laz", "cloud.las") if (path / name).is_file()]
        if not clouds:
            raise InputError(f"{path} holds no cloud.laz or cloud.las: name a cloud or the folder of a result")
        path = clouds[0]
    elif not path.is_file():
        raise InputError(f"{path} does not exist: name a cloud or the folder of a result")
    try:
        import open3d
    except (ImportError, OSError) as error:
        remedy = 'install it with: pip install "onthefly3r[cloud]"; onthefly3r doctor names missing system libraries'
        raise MissingDependencyError(f"the viewer needs open3d ({error}); {remedy}") from error
    import laspy

    try:
        with laspy.open(path) as reader:
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
