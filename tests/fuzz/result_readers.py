"""Readers of clouds, models, control, boundaries and of our own work folder, each with sound files to start from."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

POINTS = np.round(np.random.default_rng(0).uniform(0, 100, (60, 3)), 3) + np.array([5e5, 5.3e6, 100.0])
NAMES = ["flight/a 1.jpg", "flight/b 2.jpg", "flight/ä 10.jpg"]


def read_cloud(path: Path) -> object:
    """Read every point, and compare the frame with itself."""
    from onthefly3r.evaluate.clouds import open_cloud
    from onthefly3r.evaluate.same_frame import in_frame_of

    cloud = open_cloud(path)
    in_frame_of(cloud, cloud)
    return sum(len(chunk) for chunk in cloud.chunks())


def clouds(name: str) -> Callable[[], list[bytes]]:
    """Return LAS or LAZ files of two versions with a CRS."""

    def made() -> list[bytes]:
        import laspy
        from laspy.vlrs.known import WktCoordinateSystemVlr

        from onthefly3r.geometry.geodesy import wkt1

        found = []
        for version, form in (("1.2", 3), ("1.4", 7)):
            header = laspy.LasHeader(point_format=form, version=version)
            header.offsets, header.scales = np.floor(POINTS.min(axis=0)), np.full(3, 0.001)
            if version == "1.4":
                header.vlrs.append(WktCoordinateSystemVlr(wkt1("EPSG:32633", "egm96")))
                header.global_encoding.wkt = True
            cloud = laspy.LasData(header)
            cloud.x, cloud.y, cloud.z = POINTS.T
            stream = io.BytesIO()
            cloud.write(stream, do_compress=name == "laz")
            found.append(stream.getvalue())
        return found

    return made


def plys() -> list[bytes]:
    """Return PLY files as text and as binary."""
    head = "ply\nformat {} 1.0\nelement vertex 60\n" + "".join(f"property double {a}\n" for a in "xyz") + "end_header\n"
    text = "\n".join(" ".join(map(repr, row)) for row in POINTS.tolist()) + "\n"
    return [
        (head.format("ascii") + text).encode(),
        head.format("binary_little_endian").encode() + POINTS.astype("<f8").tobytes(),
        head.format("binary_big_endian").encode() + POINTS.astype(">f8").tobytes(),
    ]


def read_pose_file(path: Path) -> object:
    """Read camera poses."""
    from onthefly3r.evaluate.readers import read_poses

    return read_poses(path)


def colmap_binaries() -> list[bytes]:
    """Return images.bin of a COLMAP model."""
    import struct

    data = struct.pack("<Q", len(NAMES))
    for number, name in enumerate(NAMES, start=1):
        data += struct.pack("<I7dI", number, 1.0, 0.0, 0.0, 0.0, 1.0 * number, 2.0, 3.0, 1)
        data += name.encode() + b"\0" + struct.pack("<Q", 2) + struct.pack("<ddq", 1.0, 2.0, -1) * 2
    return [data]


def pose_texts() -> list[bytes]:
    """Return TUM and KITTI files."""
    tum = "\n".join(f"{name.replace(' ', '_')} {k} 2 3 0 0 0 1" for k, name in enumerate(NAMES))
    kitti = "\n".join(f"1 0 0 {k} 0 1 0 2 0 0 1 3" for k in range(3))
    return [tum.encode(), kitti.encode()]


def pose_tables() -> list[bytes]:
    """Return a table like our trajectory.csv."""
    head = "image,x,y,z,omega,phi,kappa,status\n"
    return [(head + "".join(f"{name},{k},2,3,10,20,30,placed\n" for k, name in enumerate(NAMES))).encode()]


def transforms() -> list[bytes]:
    """Return transforms.json of nerfstudio."""
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in NAMES]
    return [json.dumps({"camera_model": "OPENCV", "frames": frames}).encode()]


def pose_arrays() -> list[bytes]:
    """Return names and matrices as numpy writes them."""
    stream = io.BytesIO()
    np.savez(stream, names=np.array(NAMES), world_from_cam=np.tile(np.eye(4), (3, 1, 1)))
    return [stream.getvalue()]


def read_boundary_file(path: Path) -> object:
    """Read a boundary, project it, and ask it."""
    from onthefly3r.products.clip import read_boundary

    return read_boundary(path, "EPSG:32633").contains(POINTS)


def boundaries() -> list[bytes]:
    """Return GeoJSON polygons with a hole, and of several parts."""
    ring = [[15.0, 48.0], [15.01, 48.0], [15.01, 48.01], [15.0, 48.01], [15.0, 48.0]]
    hole = [[15.002, 48.002], [15.004, 48.002], [15.004, 48.004], [15.002, 48.002]]
    one = {"type": "Polygon", "coordinates": [ring, hole]}
    several = {"type": "MultiPolygon", "coordinates": [[ring], [hole]]}
    feature = {"type": "Feature", "properties": {"name": "ä"}, "geometry": one}
    return [json.dumps(v).encode() for v in (one, several, {"type": "FeatureCollection", "features": [feature]})]


def read_control_file(path: Path) -> object:
    """Read ground control."""
    from onthefly3r.earth.control_file import read_control

    return read_control(path, "EPSG:32633")


def control_lists() -> list[bytes]:
    """Return gcp_list.txt of OpenDroneMap."""
    rows = ["500000 5300000 100 120.5 80.25 a.jpg p1", "500000 5300000 100 20.5 180.25 b.jpg p1"]
    rows += ["500050 5300020 101 12.5 8.25 a.jpg CHK-2", "500050 5300020 101 90.5 8.25 b.jpg CHK-2"]
    return [("EPSG:32633\n" + "\n".join(rows) + "\n").encode()]


def control_tables() -> list[bytes]:
    """Return points and marks as CSV."""
    head = "label,x,y,z,sigma_h,sigma_v,image,px,py\n"
    return [(head + "p1,500000,5300000,100,0.02,0.03,a.jpg,1,2\np1,500000,5300000,100,0.02,0.03,b.jpg,3,4\n").encode()]


def read_job(path: Path) -> object:
    """Read a job file."""
    from onthefly3r.protocol import Job

    return Job.read(path).words()


def jobs() -> list[bytes]:
    """Return job files."""
    options = {"crs": "EPSG:32633", "limit": 3, "local": False}
    return [json.dumps({"verb": "run", "arguments": ["ä photos", "out"], "options": options}).encode()]


def in_work(name: str, read: Callable[[Path], object]) -> Callable[[Path], object]:
    """Return a reader that finds the file under its name in a work folder."""

    def reading(path: Path) -> object:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / name).write_bytes(path.read_bytes())
            return read(Path(folder))

    return reading


def read_map(work: Path) -> object:
    """Replay a journal."""
    from onthefly3r.map.state import MapState
    from onthefly3r.map.store import Store

    return MapState.load(Store(work))


def journals() -> list[bytes]:
    """Return a journal that the map wrote."""
    from test_map_state import filled

    with tempfile.TemporaryDirectory() as folder:
        filled(Path(folder))
        return [(Path(folder) / "journal.jsonl").read_bytes()]


def read_record(work: Path) -> object:
    """Read the record of a run."""
    from onthefly3r.run.record import RunRecord

    return RunRecord.read(work)


def records() -> list[bytes]:
    """Return a record that a run wrote."""
    from onthefly3r.options import Options
    from onthefly3r.run.record import RunRecord

    record = RunRecord(options=Options().to_flat(), backbone="classical 1", backbone_facts={})
    with tempfile.TemporaryDirectory() as folder:
        record.write(Path(folder))
        return [(Path(folder) / "run.json").read_bytes()]


# Name, suffix of the file, sound files, reader.
RESULT_READERS = (
    ("LAS clouds", ".las", clouds("las"), read_cloud),
    ("LAZ clouds", ".laz", clouds("laz"), read_cloud),
    ("PLY clouds", ".ply", plys, read_cloud),
    ("COLMAP binary models", ".bin", colmap_binaries, read_pose_file),
    ("TUM and KITTI files", ".txt", pose_texts, read_pose_file),
    ("tables of poses", ".csv", pose_tables, read_pose_file),
    ("transforms.json", ".json", transforms, read_pose_file),
    ("arrays of poses", ".npz", pose_arrays, read_pose_file),
    ("boundaries", ".geojson", boundaries, read_boundary_file),
    ("control lists", ".txt", control_lists, read_control_file),
    ("control tables", ".csv", control_tables, read_control_file),
    ("job files", ".job", jobs, read_job),
    ("journals", ".jsonl", journals, in_work("journal.jsonl", read_map)),
    ("records of runs", ".json", records, in_work("run.json", read_record)),
)
