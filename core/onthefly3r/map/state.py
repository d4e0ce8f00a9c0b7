"""The map M_k: accepted frames, the submaps that predicted them, and where those saw others again (Eq. 3, Eq. 14)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import islice

import numpy as np

from ..errors import InputError
from ..geometry.arrays import Float
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3, Sim3
from ..records import CompactReference, Frame, FrameEdge, NewFrame, Observations, Sighting, Submap
from .journal import camera_from_json, rigid3_from_json, rigid3_to_json, sim3_from_json, sim3_to_json, submap_from_json
from .store import Store


class MapState:
    """What is known of the scene; the only object that a committed batch changes.

    Frames and points live in the frame of the submap that predicted them, and move with it: a camera, its references
    and its part of the cloud together. The pose graph and the refinement then settle each frame on its own.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.frames: dict[int, Frame] = {}
        self.map_from_submap: dict[int, Sim3] = {}
        self.sightings: list[Sighting] = []
        self.frame_edges: list[FrameEdge] = []
        self.calibrations: dict[str, Camera] = {}
        self.spacing = float("nan")  # l_scene, map units
        self.curvatures_of: dict[int, Float] = {}  # (3,) as last found, per unit of the submap (`bending.py`)
        self._moved: dict[int, Rigid3] = {}
        self._settled: dict[int, Sim3] = {}

    @classmethod
    def load(cls, store: Store) -> MapState:
        """Return the map that a run left behind; raises `InputError` when its journal is missing or damaged."""
        state = cls(store)
        for kind, value in store.replay():
            try:
                if kind == "submap":
                    state._take(submap_from_json(value))
                elif kind == "spacing":
                    state.spacing = float(value)
                elif kind == "settled":
                    state.map_from_submap.update({int(k): sim3_from_json(v) for k, v in value["submaps"].items()})
                    state._settled.update({int(k): sim3_from_json(v) for k, v in value["frames"].items()})
                    state.curvatures_of.update({int(k): np.array(v, float) for k, v in value["curvatures"].items()})
                elif kind == "refined":
                    state._settled.update({int(k): sim3_from_json(v) for k, v in value["frames"].items()})
                    state.calibrations.update({k: camera_from_json(v) for k, v in value["calibrations"].items()})
                elif kind == "frame_poses":
                    state._moved.update({int(k): rigid3_from_json(v) for k, v in value.items()})
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise InputError(f"the journal's entry {kind!r} is damaged ({error!r}); run again") from error
        return state

    def last_accepted(self, count: int) -> list[int]:
        """Return the last frames of A_k in the order of their acceptance."""
        return list(islice(reversed(self.frames), count))[::-1]

    def next_submap(self) -> int:
        """Return the number that the next committed batch gets."""
        return len(self.map_from_submap)

    def map_from_cam(self, index: int) -> Rigid3:
        """Return the pose of an accepted frame in the map."""
        if index in self._moved:
            return self._moved[index]
        return self.submap_pose_of(index).apply_to_pose(self.frames[index].submap_from_cam)

    def reference(self, index: int) -> CompactReference:
        """Return H_i of an accepted frame, in the frame of its submap."""
        return self._store.reference(index)

    def submap_pose_of(self, index: int) -> Sim3:
        """Return map_from_submap of the submap that predicted a frame, as settled for this frame if it was."""
        return self._settled.get(index) or self.map_from_submap[self.frames[index].submap]

    def commit(self, submap: Submap, frames: Sequence[NewFrame], observations: Observations | None = None) -> None:
        """Add one validated batch (Eq. 14); it is on disk before it counts."""
        self._store.commit(submap, frames, observations)
        self._take(submap)

    def set_spacing(self, spacing: float) -> None:
        """Set l_scene once the seed is known."""
        self.spacing = spacing
        self._store.note("spacing", spacing)

    def _take(self, submap: Submap) -> None:
        self.map_from_submap[submap.number] = submap.map_from_submap
        self.frames.update({frame.index: frame for frame in submap.frames})
        self.sightings.extend(submap.sightings)
        self.frame_edges.extend(submap.frame_edges)
        for key, camera in submap.calibrations.items():
            self.calibrations.setdefault(key, camera)

    def move_submaps(
        self, map_from_submap: Mapping[int, Sim3], of_frames: Mapping[int, Sim3], curvatures_of: Mapping[int, Float]
    ) -> None:
        """Take over optimised submap poses; cameras, references and cloud follow.

        Frames in `of_frames` go where that says instead, each with its references and its part of the cloud.
        """
        self.map_from_submap.update(map_from_submap)
        self._settled.update(of_frames)
        self.curvatures_of.update(curvatures_of)
        submaps, frames = ({str(k): sim3_to_json(v) for k, v in m.items()} for m in (map_from_submap, of_frames))
        curvatures = {str(k): v.tolist() for k, v in curvatures_of.items()}
        self._store.note("settled", {"submaps": submaps, "frames": frames, "curvatures": curvatures})

    def move_refined(self, map_from_submap: Mapping[int, Sim3], calibrations: Mapping[str, Camera]) -> None:
        """Take over refined frames, each with its references and its part of the cloud, and intrinsics."""
        self._settled.update(map_from_submap)
        self.calibrations.update(calibrations)
        frames = {str(k): sim3_to_json(v) for k, v in map_from_submap.items()}
        self._store.note("refined", {"frames": frames, "calibrations": {k: asdict(c) for k, c in calibrations.items()}})

    def move_frames(self, map_from_cam: Mapping[int, Rigid3]) -> None:
        """Take over optimised camera poses only, as the paper's SE(3) graph does; the cloud stays."""
        self._moved.update(map_from_cam)
        self._store.note("frame_poses", {str(k): rigid3_to_json(v) for k, v in map_from_cam.items()})
