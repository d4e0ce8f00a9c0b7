"""What a simulated survey really looks like: cameras as a COLMAP text model, the surface as a LAS cloud."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..geometry.arrays import Float, UInt8
from .flight import Origin, Survey, TrueView, geodetic_from_enu

CLOUD_POINTS = 300_000
MODEL_POINTS = 2_000  # in points3D.txt, without tracks
MIN_VIEWS = 3  # the cloud is what so many photographs have in their frame
LAS_SCALE_M = 0.001


def write_truth(survey: Survey, folder: Path) -> None:
    """Write cameras.txt, images.txt, points3D.txt (local ENU, m), origin.json and cloud.las (UTM) into a folder.

    origin.json names the WGS 84 position of the ENU origin, the UTM zone (EPSG) and the height reference.
    """
    folder.mkdir(parents=True, exist_ok=True)
    points, rgb = truth_cloud(survey)
    utm_epsg = utm_zone_epsg(survey.origin)
    _replace(folder / "cameras.txt", _cameras_text(survey.views).encode())
    _replace(folder / "images.txt", _images_text(survey.views).encode())
    _replace(folder / "points3D.txt", _points_text(points[:MODEL_POINTS], rgb[:MODEL_POINTS]).encode())
    _replace(folder / "cloud.las", _las_bytes(projected_from_enu(points, survey.origin, utm_epsg), rgb, utm_epsg))
    place = {**asdict(survey.origin), "epsg": utm_epsg, "vertical": "ellipsoidal", "frame": "east-north-up, m"}
    _replace(folder / "origin.json", json.dumps(place, indent=2).encode())


def truth_cloud(survey: Survey, count: int = CLOUD_POINTS, seed: int = 0) -> tuple[Float, UInt8]:
    """Return points (N, 3) ENU m under the open sky that at least three views have in their frame, and colours."""
    hits = survey.scene.sample_surface(count, seed)
    views = np.zeros(len(hits.points), np.int32)
    for view in survey.views:
        pixels = view.camera.project(view.enu_from_cam.inverse().apply(hits.points))
        with np.errstate(invalid="ignore"):
            views += np.all((pixels > 0.0) & (pixels < (view.camera.width, view.camera.height)), axis=-1)
    seen = views >= min(MIN_VIEWS, len(survey.views))
    return hits.points[seen], survey.scene.colour(hits)[seen]


def utm_zone_epsg(origin: Origin) -> int:
    """Return the EPSG code of the UTM zone (WGS 84) of the origin."""
    zone = int((origin.lon_deg + 180.0) // 6.0) % 60 + 1
    return (32600 if origin.lat_deg >= 0.0 else 32700) + zone


def projected_from_enu(points: Float, origin: Origin, epsg: int) -> Float:
    """Return easting, northing, ellipsoidal height (N, 3) of points (N, 3) in local ENU."""
    import pyproj

    lon, lat, height = geodetic_from_enu(points, origin).T
    east, north = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(lon, lat)
    return np.stack([east, north, height], axis=-1)


def _cameras_text(views: Sequence[TrueView]) -> str:
    """All views share one camera, number 1."""
    c = views[0].camera
    numbers = " ".join(repr(float(v)) for v in (c.fx, c.fy, c.cx, c.cy, *c.distortion))
    return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 OPENCV {c.width} {c.height} {numbers}\n"


def _images_text(views: Sequence[TrueView]) -> str:
    from scipy.spatial.transform import Rotation

    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[]"]
    for number, view in enumerate(views, start=1):
        cam_from_enu = view.enu_from_cam.inverse()
        x, y, z, w = Rotation.from_matrix(cam_from_enu.rotation).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *cam_from_enu.translation))
        lines += [f"{number} {pose} 1 {view.name}", ""]
    return "\n".join(lines) + "\n"


def _points_text(points: Float, rgb: UInt8) -> str:
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    for number, ((x, y, z), (r, g, b)) in enumerate(zip(points, rgb, strict=True), start=1):
        lines.append(f"{number} {x:.4f} {y:.4f} {z:.4f} {r} {g} {b} 0")
    return "\n".join(lines) + "\n"


def _las_bytes(points: Float, rgb: UInt8, utm_epsg: int) -> bytes:
    """Return a LAS 1.4 file, point format 7, with the compound CRS UTM + ellipsoidal height as WKT 1."""
    import laspy
    import pyproj
    from laspy.vlrs.known import WktCoordinateSystemVlr

    horizontal = pyproj.CRS.from_epsg(utm_epsg).to_wkt("WKT1_GDAL")
    vertical = 'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1],AXIS["Up",UP]]'
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.vlrs.append(WktCoordinateSystemVlr(f'COMPD_CS["UTM + ellipsoidal height",{horizontal},{vertical}]'))
    header.global_encoding.wkt = True
    header.scales = np.full(3, LAS_SCALE_M)
    header.offsets = np.round(points.mean(axis=0))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.red, cloud.green, cloud.blue = rgb.T.astype(np.uint16) * 257
    cloud.return_number = cloud.number_of_returns = np.ones(len(points), np.uint8)
    buffer = io.BytesIO()
    cloud.write(buffer)
    return buffer.getvalue()


def _replace(path: Path, content: bytes) -> None:
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    part.replace(path)
