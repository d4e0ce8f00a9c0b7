"""The journal's values: submaps, poses, intrinsics and shots as plain JSON, and back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.camera import Camera, PixelMap
from ..geometry.transforms import Rigid3, Sim3
from ..records import (
    Attitude,
    CameraDeviation,
    ControlResidual,
    EarthTie,
    Frame,
    FrameEdge,
    GpsFix,
    Shot,
    Sighting,
    Submap,
)


def sim3_to_json(transform: Sim3) -> dict[str, Any]:
    """Return scale, rotation (row major) and translation."""
    return {
        "scale": float(transform.scale),
        "rotation": np.asarray(transform.rotation, float).tolist(),
        "translation": np.asarray(transform.translation, float).tolist(),
    }


def sim3_from_json(value: Any) -> Sim3:
    """Inverse of `sim3_to_json`."""
    return Sim3(float(value["scale"]), np.array(value["rotation"], float), np.array(value["translation"], float))


def rigid3_to_json(transform: Rigid3) -> dict[str, Any]:
    """Return rotation (row major) and translation."""
    return {"rotation": transform.rotation.tolist(), "translation": transform.translation.tolist()}


def rigid3_from_json(value: Any) -> Rigid3:
    """Inverse of `rigid3_to_json`."""
    return Rigid3(np.array(value["rotation"], float), np.array(value["translation"], float))


def camera_from_json(value: Any) -> Camera:
    """Return the camera that `dataclasses.asdict` wrote."""
    k1, k2, p1, p2 = (float(v) for v in value["distortion"])
    fx, fy, cx, cy = (float(value[name]) for name in ("fx", "fy", "cx", "cy"))
    return Camera(int(value["width"]), int(value["height"]), fx, fy, cx, cy, (k1, k2, p1, p2))


def tie_to_json(tie: EarthTie) -> dict[str, Any]:
    """Return everything of a tie to the Earth."""
    return {**asdict(tie), "enu_from_map": sim3_to_json(tie.enu_from_map)}


def tie_from_json(value: Any) -> EarthTie:
    """Inverse of `tie_to_json`."""
    return EarthTie(
        **{
            **value,
            "enu_from_map": sim3_from_json(value["enu_from_map"]),
            "deviations": {int(i): CameraDeviation(**one) for i, one in value["deviations"].items()},
            "control": tuple(ControlResidual(**{**one, "enu_m": tuple(one["enu_m"])}) for one in value["control"]),
            "warnings": tuple(value["warnings"]),
        }
    )


def submap_to_json(submap: Submap) -> dict[str, Any]:
    """Return everything of a submap but its points."""
    return {
        "number": submap.number,
        "map_from_submap": sim3_to_json(submap.map_from_submap),
        "frames": [
            {
                "index": frame.index,
                "submap": frame.submap,
                "camera": asdict(frame.camera),
                "grid_from_photo": asdict(frame.grid_from_photo),
                "submap_from_cam": rigid3_to_json(frame.submap_from_cam),
                "depth": frame.depth,
            }
            for frame in submap.frames
        ],
        "sightings": [
            {
                "frame": seen.frame,
                "submap": seen.submap,
                "frame_from_submap": sim3_to_json(seen.frame_from_submap),
                "submap_from_cam": rigid3_to_json(seen.submap_from_cam),
            }
            for seen in submap.sightings
        ],
        "frame_edges": [
            {**asdict(edge), "source_from_target": rigid3_to_json(edge.source_from_target)}
            for edge in submap.frame_edges
        ],
        "calibrations": {key: asdict(camera) for key, camera in submap.calibrations.items()},
        "metric": submap.metric,
        "fragment": submap.fragment,
    }


def submap_from_json(value: Any) -> Submap:
    """Inverse of `submap_to_json`."""
    frames = tuple(
        Frame(
            int(f["index"]),
            int(f["submap"]),
            camera_from_json(f["camera"]),
            PixelMap(**{name: float(v) for name, v in f["grid_from_photo"].items()}),
            rigid3_from_json(f["submap_from_cam"]),
            float(f["depth"]),
        )
        for f in value["frames"]
    )
    sightings = tuple(
        Sighting(
            int(s["frame"]),
            int(s["submap"]),
            sim3_from_json(s["frame_from_submap"]),
            rigid3_from_json(s["submap_from_cam"]),
        )
        for s in value["sightings"]
    )
    frame_edges = tuple(
        FrameEdge(
            int(e["source"]),
            int(e["target"]),
            rigid3_from_json(e["source_from_target"]),
            float(e["sigma_rotation_rad"]),
            float(e["sigma_translation"]),
            e["kind"],
        )
        for e in value["frame_edges"]
    )
    calibrations = {str(key): camera_from_json(camera) for key, camera in value["calibrations"].items()}
    pose = sim3_from_json(value["map_from_submap"])
    return Submap(
        number=int(value["number"]),
        map_from_submap=pose,
        frames=frames,
        sightings=sightings,
        frame_edges=frame_edges,
        calibrations=calibrations,
        metric=bool(value.get("metric", False)),
        fragment=int(value.get("fragment", 0)),
    )


def shot_to_json(shot: Shot) -> dict[str, Any]:
    """Return all of a shot, its path as text."""
    return {**asdict(shot), "path": str(shot.path)}


def shot_from_json(value: Any) -> Shot:
    """Inverse of `shot_to_json`."""
    known = dict(value)
    gps, attitude = known.pop("gps"), known.pop("attitude")
    known["path"] = Path(known["path"])
    known["warnings"] = tuple(known["warnings"])
    for name in ("value_range", "stamp"):
        known[name] = tuple(known[name]) if known.get(name) else None
    return Shot(**known, gps=GpsFix(**gps) if gps else None, attitude=Attitude(**attitude) if attitude else None)
