"""What each pass of the pose graph did, read from the journal that the engine leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from onthefly3r.geometry.transforms import Rigid3, Sim3
from onthefly3r.map.journal import rigid3_from_json, sim3_from_json, submap_from_json
from onthefly3r.map.store import Store
from onthefly3r.records import Frame


@dataclass(frozen=True)
class GraphPass:
    """map_from_cam of all frames in the map, before and after one optimisation."""

    before: Mapping[int, Rigid3]
    after: Mapping[int, Rigid3]


def graph_passes(store: Store) -> tuple[GraphPass, ...]:
    """Replay a journal; raises `InputError` when it is damaged."""
    frames: dict[int, Frame] = {}
    map_from_submap: dict[int, Sim3] = {}
    settled: dict[int, Sim3] = {}  # frames that do not follow their submap
    moved: dict[int, Rigid3] = {}
    passes = []

    def cameras() -> dict[int, Rigid3]:
        return {
            i: moved[i]
            if i in moved
            else (settled.get(i) or map_from_submap[f.submap]).apply_to_pose(f.submap_from_cam)
            for i, f in frames.items()
        }

    for kind, value in store.replay():
        if kind == "submap":
            submap = submap_from_json(value)
            map_from_submap[submap.number] = submap.map_from_submap
            frames.update({frame.index: frame for frame in submap.frames})
        elif kind in ("settled", "frame_poses"):
            before = cameras()
            if kind == "settled":
                map_from_submap.update({int(k): sim3_from_json(v) for k, v in value["submaps"].items()})
                settled.update({int(k): sim3_from_json(v) for k, v in value["frames"].items()})
            else:
                moved.update({int(k): rigid3_from_json(v) for k, v in value.items()})
            passes.append(GraphPass(before, cameras()))
    return tuple(passes)
