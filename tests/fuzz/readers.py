"""The readers that are fuzzed, each with sound files to start from: add a `Reader` to `READERS`."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from .result_readers import RESULT_READERS


@dataclass(frozen=True)
class Reader:
    """What reads a file and must end in a result or an error of our own tree, in time and in bounds of memory."""

    name: str
    suffix: str
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]


def read_photograph(path: Path) -> object:
    """Read the tags, then the pixels."""
    from onthefly3r.intake.images import load_working_image
    from onthefly3r.intake.metadata import read_shot
    from onthefly3r.intake.stamp import Patience
    from onthefly3r.options import IntakeOptions

    shot = read_shot(path, path.name, IntakeOptions(min_side_px=16))
    return load_working_image(shot, 200, patience=Patience(0.0))


def read_position_file(path: Path) -> object:
    """Read a position file and give its positions to photographs."""
    from onthefly3r.intake.positions_file import read_positions, with_positions
    from onthefly3r.records import GpsFix, Shot

    shot = Shot("a.jpg", Path("a.jpg"), 800, 600, "cam", 0.7, 0.05, "guess", gps=GpsFix(48.2, 15.5, 300.0))
    return with_positions([shot], read_positions(path))


def read_xmp(path: Path) -> object:
    """Scan a packet and interpret what it says."""
    from onthefly3r.intake.attitude import read_above_takeoff_m, read_attitude
    from onthefly3r.intake.position import read_fix
    from onthefly3r.intake.tags import Tags
    from onthefly3r.intake.xmp import parse_xmp

    tags = Tags(xmp=parse_xmp(path.read_bytes()))
    return read_fix(tags), read_attitude(tags), read_above_takeoff_m(tags)


def packets() -> list[bytes]:
    """Return XMP packets in the vocabularies of several makers."""
    namespaces = (
        'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" xmlns:Camera="http://pix4d.com/camera/1.0/" '
        'xmlns:drone-skydio="https://www.skydio.com/drone-skydio/1.0/" xmlns:exif="http://ns.adobe.com/exif/1.0/"'
    )
    bodies = (
        'drone-dji:AbsoluteAltitude="+198.31" drone-dji:RelativeAltitude="+39.80" drone-dji:GpsLatitude="46.84260708" '
        'drone-dji:GpsLongtitude="-91.99455989" drone-dji:GimbalYawDegree="+45.00" '
        'drone-dji:GimbalPitchDegree="-89.90" drone-dji:GimbalRollDegree="+0.00" drone-dji:RtkFlag="50" '
        'drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.013" drone-dji:RtkStdHgt="0.03" '
        'drone-dji:AltitudeType="RtkAlt"',
        'Camera:Yaw="146.7" Camera:Pitch="38.0" Camera:Roll="-0.04" Camera:GPSXYAccuracy="845389/2097152" '
        'Camera:VertCS="EPSG:5773" exif:GPSLatitude="48,21.1367729N" exif:GPSLongitude="2,49.155405E"',
    )
    skydio = (
        '<drone-skydio:CameraOrientationNED rdf:parseType="Resource"><drone-skydio:Yaw>1</drone-skydio:Yaw>'
        "<drone-skydio:Pitch>-90</drone-skydio:Pitch><drone-skydio:Roll>0</drone-skydio:Roll>"
        "</drone-skydio:CameraOrientationNED>"
    )
    return [
        (
            '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
            'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
            f'{namespaces} {body}>{skydio}</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
        ).encode()
        for body in bodies
    ]


def pixels(dtype: Any = np.uint8, channels: int = 3) -> Any:
    """Return a small picture that no decoder finds trivial."""
    top = np.iinfo(dtype).max
    values = np.random.default_rng(0).integers(0, top, (20, 24, channels) if channels > 1 else (20, 24))
    return np.kron(values, np.ones((3, 3, 1) if channels > 1 else (3, 3))).astype(dtype)


def exif() -> Any:
    """Return the EXIF block of a drone's photograph."""
    from PIL import Image

    block = Image.Exif()
    block[0x010F], block[0x0110], block[0x0112], block[0x0132] = "DJI", "FC300S", 6, "2024:05:01 10:00:00"
    details = block.get_ifd(0x8769)
    details.update({0x9000: b"0230", 0x9003: "2024:05:01 10:00:00", 0x9291: "75", 0x920A: 3.61, 0xA405: 20})
    details.update({0xA20E: 4865.6, 0xA210: 2, 0xA002: 72, 0xA003: 60, 0xA404: 1.0})
    gps = block.get_ifd(0x8825)
    gps.update({1: "N", 2: (46.0, 50.0, 33.3855), 3: "W", 4: (91.0, 59.0, 40.4156), 5: b"\0", 6: 198.309, 31: 2.5})
    return block


def saved(format: str, values: Any, **options: Any) -> bytes:
    """Return the bytes of a picture in a format of Pillow's."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(values).save(stream, format, **options)
    return stream.getvalue()


def jpegs() -> list[bytes]:
    """Return JPEGs: ordinary, progressive, and with a second picture."""
    from PIL import Image

    packet = packets()[0]
    found = [
        saved("JPEG", pixels(), exif=exif(), xmp=packet),
        saved("JPEG", pixels(), exif=exif(), progressive=True),
        saved("JPEG", pixels(channels=1)),
    ]
    second = Image.fromarray(pixels()[::2, ::2].copy())
    return [*found, saved("MPO", pixels(), save_all=True, append_images=[second])]


def pngs() -> list[bytes]:
    """Return PNGs of several pixel types."""
    import cv2

    colour = cv2.imencode(".png", pixels(np.uint16))[1].tobytes()
    return [
        saved("PNG", pixels(), exif=exif()),
        saved("PNG", pixels(np.uint16, 1)),
        saved("PNG", pixels(channels=4)),
        colour,
    ]


def tiffs() -> list[bytes]:
    """Return TIFFs of several pixel types and compressions."""
    import cv2

    colour = cv2.imencode(".tif", pixels(np.uint16))[1].tobytes()
    return [
        saved("TIFF", pixels(), exif=exif()),
        saved("TIFF", pixels(), compression="tiff_lzw"),
        saved("TIFF", pixels(np.uint16, 1)),
        saved("TIFF", pixels(np.int32, 1)),
        colour,
    ]


def heics() -> list[bytes]:
    """Return a HEIC picture."""
    import pillow_heif

    pillow_heif.register_heif_opener()
    return [saved("HEIF", pixels(), exif=exif().tobytes())]


def position_files() -> list[bytes]:
    """Return position files with every separator."""
    lines = [
        "EPSG:4326\na.jpg 15.5 48.2 310 30 10 1 0.02 0.04\nb c.jpg 15.5 48.2 nan # note\n",
        "EPSG:32633+5773\na.jpg\t500000\t5300000\t310\nb.jpg\t500010\t5300000\t310\n",
        "EPSG:4979\na.jpg;15,5;48,2;310,5\nb.jpg;15,6;48,2;311\n",
        "EPSG:26849+6360,,,\nname,x,y,z\na.jpg,2901317.6,455027.9,650\n",
        "+proj=utm +zone=33 +datum=WGS84 +units=m\na.jpg 500000 5300000\n",
        "WGS84 UTM 33N\na.jpg 500000 5300000 1\n",
    ]
    return [*(line.encode() for line in lines), lines[0].encode("utf-16"), lines[1].encode("utf-8-sig")]


READERS = [
    Reader("JPEG photographs", ".jpg", jpegs, read_photograph),
    Reader("PNG photographs", ".png", pngs, read_photograph),
    Reader("TIFF photographs", ".tif", tiffs, read_photograph),
    Reader("XMP packets", ".xmp", packets, read_xmp),
    Reader("position files", ".txt", position_files, read_position_file),
]
READERS += [Reader(*parts) for parts in RESULT_READERS]
if find_spec("pillow_heif") is not None:
    READERS.append(Reader("HEIC photographs", ".heic", heics, read_photograph))
