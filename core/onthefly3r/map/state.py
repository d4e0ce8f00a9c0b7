"""The map M_k: accepted frames, the submaps that predicted them, and where those saw others again (Eq. 3, Eq. 14)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from itertools import islice

import numpy as np

from ..errors import InputError
from ..geometry.arrays import Float
from ..geometry.camera import Camera
from ..geometry.transforms import Rigid3, Sim3
from ..records import CompactReference, EarthTie, Frame, FrameEdge, NewFrame, Observations, Sighting, Submap
from .journal import (
    camera_from_json,
    rigid3_from_json,
    rigid3_to_json,
    sim3_from_json,
    sim3_to_json,
    submap_from_json,
    tie_from_json,
    tie_to_json,
)
from .store import Store


class MapState:
    """What is known of the scene; the only object that a committed batch changes.

    Frames and points live in the frame of the submap that predicted them, and move with it: a camera, its references
    and its part of the cloud together. The pose graph and the refinement then settle each frame on its own.

    A map may be in fragments that nothing connects yet. Each has a frame of its own, which "map" means in every name
    here, and is named by the number of its first submap. `part` shows one of them as a map; `join` makes one of two.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self.frames: dict[int, Frame] = {}
        self.map_from_submap: dict[int, Sim3] = {}
        self.sightings: list[Sighting] = []
        self.frame_edges: list[FrameEdge] = []
        self.calibrations: dict[str, Camera] = {}
        self.fragment_of_submap: dict[int, int] = {}
        self.metric_submaps: set[int] = set()  # those whose own units are metres
        self._spacing_of: dict[int, float] = {}  # l_scene of each fragment, in its units
        self.curvatures_of: dict[int, Float] = {}  # (3,) as last found, per unit of the submap (`bending.py`)
        self._moved: dict[int, Rigid3] = {}
        self._settled: dict[int, Sim3] = {}
        self.tie: EarthTie | None = None  # how the adjusted map lies on the Earth

    @classmethod
    def load(cls, store: Store) -> MapState:
        """Return the map that a run left behind; raises `InputError` when its journal is missing or damaged."""
        state = cls(store)
        for kind, value in store.replay():
            try:
                if kind == "submap":
                    state._take(submap_from_json(value))
                elif kind == "spacing":
                    state._spacing_of[int(value["fragment"])] = float(value["spacing"])
                elif kind == "joined":
                    state._join(int(value["from"]), int(value["into"]), sim3_from_json(value["into_from_from"]))
                elif kind == "parted":
                    state._part_with([int(n) for n in value["submaps"]], int(value["fragment"]))
                elif kind == "settled":
                    state.map_from_submap.update({int(k): sim3_from_json(v) for k, v in value["submaps"].items()})
                    state._settled.update({int(k): sim3_from_json(v) for k, v in value["frames"].items()})
                    state.curvatures_of.update({int(k): np.array(v, float) for k, v in value["curvatures"].items()})
                elif kind == "refined":
                    state._settled.update({int(k): sim3_from_json(v) for k, v in value["frames"].items()})
                    state.calibrations.update({k: camera_from_json(v) for k, v in value["calibrations"].items()})
                elif kind == "tie":
                    state.tie = tie_from_json(value)
                elif kind == "frame_poses":
                    state._moved.update({int(k): rigid3_from_json(v) for k, v in value.items()})
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise InputError(f"the journal's entry {kind!r} is damaged ({error!r}); run again") from error
        return state

    @property
    def spacing(self) -> float:
        """l_scene in map units, of the largest fragment; NaN before there is one."""
        return self._spacing_of.get(next(iter(self.fragments()), 0), float("nan"))

    @property
    def metres_per_unit(self) -> float | None:
        """What metric local models say of the map's scale: the median over their submaps, None without any."""
        scales = [self.map_from_submap[number].scale for number in self.metric_submaps]
        return 1.0 / float(np.median(scales)) if scales else None

    def fragment_of(self, index: int) -> int:
        """Return the fragment that an accepted frame lies in."""
        return self.fragment_of_submap[self.frames[index].submap]

    def fragments(self) -> dict[int, list[int]]:
        """Return the frames of each fragment in the order of their acceptance, the largest fragment first."""
        found: dict[int, list[int]] = {}
        for index in self.frames:
            found.setdefault(self.fragment_of(index), []).append(index)
        return dict(sorted(found.items(), key=lambda item: (-len(item[1]), item[0])))

    def part(self, fragment: int) -> MapState:
        """Return one fragment as a map of its own: what is moved there moves here too."""
        if all(number == fragment for number in self.fragment_of_submap.values()):
            return self
        return MapPart(self, (fragment,))

    def parts(self, fragments: Collection[int]) -> MapState:
        """Return some fragments as a map; only where they were brought into one frame."""
        return self if {*self.fragment_of_submap.values()} <= {*fragments} else MapPart(self, fragments)

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

    def set_spacing(self, spacing: float, fragment: int = 0) -> None:
        """Set l_scene of a fragment once its seed is known."""
        self._spacing_of[fragment] = spacing
        self._store.note("spacing", {"fragment": fragment, "spacing": spacing})

    def join(self, source: int, into: int, into_from_source: Sim3) -> None:
        """Make one fragment of two that were found to overlap; sightings across them count from now on."""
        self._join(source, into, into_from_source)
        self._store.note("joined", {"from": source, "into": into, "into_from_from": sim3_to_json(into_from_source)})

    def part_with(self, submaps: Sequence[int], fragment: int) -> None:
        """Undo a join: make a fragment of its own of some submaps, and forget the sightings that tied them."""
        self._part_with(submaps, fragment)
        self._store.note("parted", {"submaps": list(submaps), "fragment": fragment})

    def shift(self, fragment: int, target_from_map: Sim3) -> None:
        """Show a fragment in another frame for the export: this is not kept, its frame stays its own business."""
        for number, label in self.fragment_of_submap.items():
            if label == fragment:
                self.map_from_submap[number] = target_from_map @ self.map_from_submap[number]
        for index in self.frames:
            if self.fragment_of(index) == fragment:
                if index in self._settled:
                    self._settled[index] = target_from_map @ self._settled[index]
                if index in self._moved:
                    self._moved[index] = target_from_map.apply_to_pose(self._moved[index])

    def _join(self, source: int, into: int, into_from_source: Sim3) -> None:
        self.shift(source, into_from_source)
        for number, label in self.fragment_of_submap.items():
            if label == source:
                self.fragment_of_submap[number] = into

    def _part_with(self, submaps: Sequence[int], fragment: int) -> None:
        (before,) = {self.fragment_of_submap[number] for number in submaps}
        self._spacing_of[fragment] = self._spacing_of[before]
        self.fragment_of_submap.update(dict.fromkeys(submaps, fragment))
        self.sightings = [s for s in self.sightings if self.fragment_of(s.frame) == self.fragment_of_submap[s.submap]]

    def _take(self, submap: Submap) -> None:
        self.map_from_submap[submap.number] = submap.map_from_submap
        self.fragment_of_submap[submap.number] = submap.fragment
        if submap.metric:
            self.metric_submaps.add(submap.number)
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

    def set_tie(self, tie: EarthTie) -> None:
        """Take over how the adjusted map lies on the Earth; what moves frames later makes it untrue."""
        self.tie = tie
        self._store.note("tie", tie_to_json(tie))

    def move_frames(self, map_from_cam: Mapping[int, Rigid3]) -> None:
        """Take over optimised camera poses only, as the paper's SE(3) graph does; the cloud stays."""
        self._moved.update(map_from_cam)
        self._store.note("frame_poses", {str(k): rigid3_to_json(v) for k, v in map_from_cam.items()})


class MapPart(MapState):
    """Some of the fragments of a map as it is now: a map to read and to move, but not to add to."""

    def __init__(self, whole: MapState, fragments: Collection[int]) -> None:
        super().__init__(whole._store)
        self._whole = whole
        self.fragment_of_submap = {n: label for n, label in whole.fragment_of_submap.items() if label in fragments}
        self.map_from_submap = {number: whole.map_from_submap[number] for number in self.fragment_of_submap}
        self.metric_submaps = whole.metric_submaps & set(self.map_from_submap)
        self.frames = {i: frame for i, frame in whole.frames.items() if frame.submap in self.map_from_submap}
        self.sightings = [
            seen for seen in whole.sightings if seen.submap in self.map_from_submap and seen.frame in self.frames
        ]
        self.frame_edges = [e for e in whole.frame_edges if e.source in self.frames and e.target in self.frames]
        self.calibrations, self.curvatures_of = whole.calibrations, whole.curvatures_of
        self._spacing_of, self._moved, self._settled = whole._spacing_of, whole._moved, whole._settled

    def next_submap(self) -> int:
        """Return the number that the next committed batch of the whole map gets."""
        return self._whole.next_submap()

    def commit(self, submap: Submap, frames: Sequence[NewFrame], observations: Observations | None = None) -> None:
        """Refuse: batches are added to the whole map."""
        raise TypeError("a part of a map is not added to; commit to the map itself")

    def set_tie(self, tie: EarthTie) -> None:
        """Take it over for the whole map, whose largest fragment this must be."""
        self.tie = tie
        self._whole.set_tie(tie)

    def move_submaps(
        self, map_from_submap: Mapping[int, Sim3], of_frames: Mapping[int, Sim3], curvatures_of: Mapping[int, Float]
    ) -> None:
        """Move them in the whole map."""
        self.map_from_submap.update(map_from_submap)
        self._whole.move_submaps(map_from_submap, of_frames, curvatures_of)
