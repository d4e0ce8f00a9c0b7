"""Cameras for other programs: angles as text, GeoJSON, Metashape XML, Pix4D CSV, and calibrations as JSON.

All are of the upright photographs, like the tables of this result; the COLMAP model is that of the files as stored.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from ..files.atomic import write_text
from ..geometry.arrays import Float
from ..geometry.camera import Camera
from ..records import PlacedCamera
from .rows import CameraRow

EXCHANGE_FILES = (
    "exchange/opk.txt",
    "exchange/shots.geojson",
    "exchange/metashape.xml",
    "exchange/pix4d.csv",
    "exchange/calibration.json",
)


def write_exchange(out: Path, cameras: Sequence[PlacedCamera], rows: Sequence[CameraRow], crs: str | None) -> None:
    """Write `EXCHANGE_FILES` below `out`; rejected photographs are left out."""
    placed = [row for row in rows if row.status == "placed"]
    texts = (
        opk_text(placed, crs),
        json.dumps(shots_geojson(placed, crs), ensure_ascii=False, indent=1) + "\n",
        metashape_xml(cameras, crs),
        pix4d_csv(placed),
        json.dumps({key: calibration(camera) for key, camera in _by_camera(cameras, placed).items()}, indent=1) + "\n",
    )
    for name, text in zip(EXCHANGE_FILES, texts, strict=True):
        write_text(out / name, text)


def opk_text(rows: Sequence[CameraRow], crs: str | None) -> str:
    """Return lines `image x y z omega phi kappa`, m and degrees, tabs between: what PATB and BLUH readers import."""
    lines = [f"# {crs or 'local frame'}; omega, phi, kappa in degrees", "# image\tx\ty\tz\tomega\tphi\tkappa"]
    for row in rows:
        numbers = [row.x, row.y, row.z, row.omega, row.phi, row.kappa]
        lines.append("\t".join([row.image, *(f"{float(v or 0.0):.6f}" for v in numbers)]))
    return "\n".join(lines) + "\n"


def pix4d_csv(rows: Sequence[CameraRow]) -> str:
    """Return Pix4D's table: imagename, X, Y, Z, Omega, Phi, Kappa, and accuracies where known."""
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["imagename", "X", "Y", "Z", "Omega", "Phi", "Kappa", "AccuracyHorz", "AccuracyVert"])
    for row in rows:
        numbers = (row.x, row.y, row.z, row.omega, row.phi, row.kappa)
        known = ["" if v is None else f"{v:.4f}" for v in (row.sd_h, row.sd_v)]
        table.writerow([row.image, *(f"{float(v or 0.0):.6f}" for v in numbers), *known])
    return text.getvalue()


def shots_geojson(rows: Sequence[CameraRow], crs: str | None) -> dict[str, Any]:
    """Return the cameras as points, longitude and latitude where there is a CRS, with pose and deviations."""
    to_lon_lat = None
    if crs is not None:
        from pyproj import Transformer

        to_lon_lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform
    names = ("omega", "phi", "kappa", "yaw", "pitch", "roll", "sd_h", "sd_v", "sd_deg", "x", "y", "z", "cam", "t_utc")
    features = []
    for row in rows:
        x, y = float(row.x or 0.0), float(row.y or 0.0)
        lon, lat = to_lon_lat(x, y) if to_lon_lat else (x, y)
        properties = {"filename": row.image, "number": row.number, **{name: getattr(row, name) for name in names}}
        geometry = {"type": "Point", "coordinates": [lon, lat, row.z]}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "crs_of_x_y_z": crs, "features": features}


def metashape_xml(cameras: Sequence[PlacedCamera], crs: str | None) -> str:
    """Return cameras as Metashape's XML: sensors with its calibration terms, and world_from_cam of every photograph."""
    sensors: dict[Camera, int] = {}
    for placed in cameras:
        sensors.setdefault(placed.camera, len(sensors))
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<document version="1.4.0">', '  <chunk label="onthefly3r">']
    lines.append("    <sensors>")
    for camera, number in sensors.items():
        own = calibration(camera)["metashape"]
        size = f'width="{camera.width}" height="{camera.height}"'
        lines.append(f'      <sensor id="{number}" label="camera {number}" type="frame">')
        lines.append(f"        <resolution {size}/>")
        lines.append('        <calibration type="frame" class="adjusted">')
        lines.append(f"          <resolution {size}/>")
        lines += [f"          <{name}>{value!r}</{name}>" for name, value in own.items()]
        lines += ["        </calibration>", "      </sensor>"]
    lines += ["    </sensors>", "    <cameras>"]
    for placed in cameras:
        label = quoteattr(placed.name.encode("utf-8", "replace").decode())
        lines.append(
            f'      <camera id="{placed.index}" sensor_id="{sensors[placed.camera]}" label={label} enabled="true">'
        )
        lines.append(f"        <transform>{_row_major(placed.world_from_cam.matrix())}</transform>")
        lines.append("      </camera>")
    lines.append("    </cameras>")
    if crs is not None:
        from pyproj import CRS

        lines.append(f"    <reference>{_escaped(CRS.from_user_input(crs).to_wkt('WKT1_GDAL'))}</reference>")
    return "\n".join([*lines, "  </chunk>", "</document>"]) + "\n"


def calibration(camera: Camera) -> dict[str, Any]:
    """Return one camera in the conventions of OpenCV, Metashape and Pix4D.

    OpenCV counts pixels from the centre of the first one, the others from its corner. Metashape has the principal point
    from the middle, b1 = fx - fy, and its p1 is OpenCV's p2 and the other way round.
    """
    k1, k2, p1, p2 = camera.distortion
    metashape = {
        "f": camera.fy,
        "cx": camera.cx - camera.width / 2,
        "cy": camera.cy - camera.height / 2,
        "k1": k1,
        "k2": k2,
        "p1": p2,
        "p2": p1,
        "b1": camera.fx - camera.fy,
    }
    return {
        "width": camera.width,
        "height": camera.height,
        "opencv": {
            "camera_matrix": [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]],
            "distortion": [k1, k2, p1, p2, 0.0],
        },
        "metashape": metashape,
        "pix4d": {
            "focal_px": camera.fy,
            "principal_point_px": [camera.cx, camera.cy],
            "radial": [k1, k2, 0.0],
            "tangential": [p1, p2],
        },
    }


def _by_camera(cameras: Sequence[PlacedCamera], rows: Sequence[CameraRow]) -> dict[str, Camera]:
    """Return the calibrations by camera key; photographs of one key that differ are told apart by their name."""
    key_of = {row.number: row.cam for row in rows}
    found: dict[str, Camera] = {}
    for placed in cameras:
        key = key_of.get(placed.index + 1, placed.name)
        found[key if found.get(key, placed.camera) == placed.camera else f"{key} ({placed.name})"] = placed.camera
    return found


def _row_major(matrix: Float) -> str:
    return " ".join(repr(float(v)) for v in matrix.ravel())


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
