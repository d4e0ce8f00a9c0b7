"""Photographs of a simulated survey: JPEG files with the EXIF and XMP tags of a drone."""

from __future__ import annotations

import math
import time
import zlib
from pathlib import Path

import numpy as np

from ..files.atomic import replacing
from ..geometry.arrays import UInt8
from .flight import TrueView
from .scene import Scene

SUPERSAMPLING = 1.5  # samples per pixel side: smooths the outlines of houses
SENSOR_NOISE = 1.5  # standard deviation in grey levels
BAND_ROWS = 128
FOCAL_35MM = 24
FOCAL_MM = 8.8
MAKER, MODEL = "OnTheFly3R", "Simulator"
EXIF_IFD, GPS_IFD = 0x8769, 0x8825


def render(scene: Scene, view: TrueView, supersampling: float = SUPERSAMPLING) -> UInt8:
    """Return the photograph (H, W, 3) RGB of a view, the same for the same arguments."""
    import cv2

    fine = view.camera.resized(round(view.camera.width * supersampling), round(view.camera.height * supersampling))
    footprint_m = abs(float(view.enu_from_cam.translation[2])) / fine.fx
    columns = np.arange(fine.width) + 0.5
    bands = []
    for top in range(0, fine.height, BAND_ROWS):  # bands fit the processor's caches
        rows = np.arange(top, min(top + BAND_ROWS, fine.height)) + 0.5
        hits = scene.view(fine, view.enu_from_cam, np.stack(np.meshgrid(columns, rows), axis=-1))
        bands.append(scene.colour(hits, footprint_m))
    image = np.concatenate(bands).reshape(fine.height, fine.width, 3)
    image = cv2.resize(image, (view.camera.width, view.camera.height), interpolation=cv2.INTER_AREA)
    rng = np.random.default_rng(zlib.crc32(view.name.encode()))
    noise = SENSOR_NOISE * rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(np.clip(image + noise + 0.5, 0, 255), np.uint8)


def write_photograph(path: Path, rgb: UInt8, view: TrueView) -> None:
    """Write a JPEG with the tags of a drone; relative altitudes count from the mean ground."""
    from PIL import Image

    packet = _xmp(view).encode("utf-8")
    with replacing(path) as temporary:
        Image.fromarray(rgb).save(temporary, "JPEG", quality=92, exif=_exif(view), xmp=packet)


def _exif(view: TrueView) -> bytes:
    from PIL import Image

    stamp = time.strftime("%Y:%m:%d %H:%M:%S", time.gmtime(view.time_s))
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112], exif[0x0132] = MAKER, MODEL, 1, stamp
    details = exif.get_ifd(EXIF_IFD)
    details[0x9003] = details[0x9004] = stamp  # DateTimeOriginal, DateTimeDigitized
    details[0x920A], details[0xA405] = FOCAL_MM, FOCAL_35MM
    details[0xA002], details[0xA003] = view.camera.width, view.camera.height
    fix, gps = view.gps, exif.get_ifd(GPS_IFD)
    gps[0] = b"\x02\x03\x00\x00"
    gps[1], gps[2] = "N" if fix.lat_deg >= 0 else "S", _degrees_minutes_seconds(fix.lat_deg)
    gps[3], gps[4] = "E" if fix.lon_deg >= 0 else "W", _degrees_minutes_seconds(fix.lon_deg)
    if fix.height_m is not None:
        gps[5], gps[6] = bytes([int(fix.height_m < 0)]), round(abs(fix.height_m), 3)
    return exif.tobytes()


def _degrees_minutes_seconds(angle_deg: float) -> tuple[float, float, float]:
    minutes, degrees = math.modf(abs(angle_deg))
    seconds, minutes = math.modf(minutes * 60.0)
    return degrees, minutes, round(seconds * 60.0, 7)


def _xmp(view: TrueView) -> str:
    """Return the packet in the vocabulary that DJI drones write."""
    fix = view.gps
    height_m = fix.height_m or 0.0
    tags = {
        "AltitudeType": "RtkAlt" if fix.vertical == "ellipsoidal" else "GpsFusionAlt",
        "GpsLatitude": f"{fix.lat_deg:+.9f}",
        "GpsLongitude": f"{fix.lon_deg:+.9f}",
        "AbsoluteAltitude": f"{height_m:+.3f}",
        "RelativeAltitude": f"{view.enu_from_cam.translation[2]:+.3f}",
        "GimbalRollDegree": f"{view.attitude.roll_deg:+.2f}",
        "GimbalYawDegree": f"{view.attitude.yaw_deg:+.2f}",
        "GimbalPitchDegree": f"{view.attitude.pitch_deg:+.2f}",
    }
    if fix.rtk is not None:
        tags |= {
            "RtkFlag": str(fix.rtk),
            "RtkStdLon": f"{fix.sigma_h_m:.5f}",
            "RtkStdLat": f"{fix.sigma_h_m:.5f}",
            "RtkStdHgt": f"{fix.sigma_v_m:.5f}",
        }
    attributes = "\n".join(f'   drone-dji:{name}="{value}"' for name, value in tags.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n  <rdf:Description rdf:about=""\n'
        f'   xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"\n{attributes}/>\n'
        ' </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    )
