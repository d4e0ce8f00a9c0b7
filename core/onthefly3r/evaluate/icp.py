"""Rigid refinement of one cloud onto another (point-to-plane ICP, Chen and Medioni 1992) with open3d."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import MissingDependencyError, ReferenceFormatError, require_memory
from ..geometry.arrays import Float
from ..geometry.spacing import point_spacing
from ..geometry.transforms import Sim3
from .clouds import CloudFile
from .surface import sample

SYSTEM_LIBRARIES = "apt-get install libegl1 libgl1 libx11-6 libusb-1.0-0 libudev1 libidn2-0"
MAX_POINTS = 200_000
REACHES = (50.0, 15.0, 5.0)  # how far apart partners may be, in point spacings of the reference, from coarse to fine
MAX_ITERATIONS = 60
MIN_FITNESS = 0.1  # share of points with a partner below which the clouds do not overlap


def refine(result: CloudFile, reference: CloudFile, reference_from_result: Sim3) -> Sim3:
    """Return the rigid motion in the reference's frame that lays the moved result onto the reference.

    The motion is to be applied after `reference_from_result`; its scale is 1.

    Raises:
        MissingDependencyError: open3d, or a system library that it needs, is missing.
        ReferenceFormatError: the clouds are too far apart to find partners.
    """
    open3d = import_open3d()
    moved = reference_from_result.apply(sample(result, MAX_POINTS))
    target = sample(reference, MAX_POINTS)
    origin = np.median(target, axis=0)  # projected coordinates are large
    spacing = point_spacing(target)
    source_cloud, target_cloud = _cloud(open3d, moved - origin), _cloud(open3d, target - origin)
    registration = open3d.pipelines.registration
    target_cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(knn=20))
    motion = np.eye(4)
    for reach in REACHES:
        found = registration.registration_icp(
            source_cloud,
            target_cloud,
            reach * spacing,
            motion,
            registration.TransformationEstimationPointToPlane(),
            registration.ICPConvergenceCriteria(max_iteration=MAX_ITERATIONS),
        )
        if found.fitness < MIN_FITNESS:
            raise ReferenceFormatError(
                f"{reference.path}: only {found.fitness:.0%} of {result.path} lies within {reach * spacing:.2g} of it; "
                "check that both have the same CRS, or align by the cameras first"
            )
        motion = np.array(found.transformation)
    rotation, translation = motion[:3, :3], motion[:3, 3]
    return Sim3(1.0, rotation, translation + origin - rotation @ origin)


def import_open3d() -> Any:
    """Import open3d or raise `MissingDependencyError` that says what to install."""
    try:
        import open3d
    except ModuleNotFoundError as error:
        if error.name != "open3d":
            raise MissingDependencyError(f"open3d needs {error.name}: pip install 'onthefly3r[cloud]'") from None
        raise MissingDependencyError("this needs open3d: pip install 'onthefly3r[cloud]'") from None
    except (ImportError, OSError) as error:
        require_memory(error)  # else it is a shared library that the wheel does not bring
        raise MissingDependencyError(
            f"open3d does not start ({error}); on Debian and Ubuntu: {SYSTEM_LIBRARIES}"
        ) from None
    return open3d


def _cloud(open3d: Any, points: Float) -> Any:
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.ascontiguousarray(points)))
