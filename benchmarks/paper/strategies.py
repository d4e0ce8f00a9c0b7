"""Ways to scale one frozen local reconstructor to many images, side by side.

`on-the-fly` is ours and `paper` its preset; `case-1` to `case-4` switch parts of ours off. The others are written from
the ideas of their methods: `vanilla` (one joint inference), `chunks` (as VGGT-Long, with sizes and loops that suit the
memory and descriptors here; `chunks-published` has the published settings), `interleaved` (the partition of MERG3R,
without its bundle adjustment) and `graph-cuts` (parts of the retrieval graph, no published method).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from onthefly3r.backbones.base import Backbone, BackboneSpec, ExtractsFeatures
from onthefly3r.engine.loop import Engine
from onthefly3r.geometry.camera import Camera
from onthefly3r.geometry.transforms import Rigid3
from onthefly3r.intake.cache import ImageCache
from onthefly3r.options import Options
from onthefly3r.records import LocalModel, Rejection, Shot, Subset, WorkingImage
from onthefly3r.selection.describer import Describer
from onthefly3r.selection.index import RetrievalIndex

from .chunks import FITTING, PUBLISHED, place_chunks
from .interleaved import place_interleaved
from .partition import place_parts
from .passes import GraphPass, graph_passes

JOINT_LIMIT = 58  # images that every backbone of the paper's tab:vfm_comparison takes at once in 24 GB

# Cases of the paper's tab:ablation on our engine; its case 5, with everything on, is `on-the-fly` itself.
ABLATION: dict[str, dict[str, object]] = {
    "case-1": {"batching": "fixed", "validation": False, "pose_graph": "none"},
    "case-2": {"batching": "dynamic", "validation": False, "pose_graph": "none"},
    "case-3": {"batching": "fixed", "validation": True, "pose_graph": "none"},
    "case-4": {"batching": "dynamic", "validation": True, "pose_graph": "none"},
}

ENGINE_OPTIONS: dict[str, dict[str, object]] = {"on-the-fly": {}, "paper": {"preset": "paper"}, **ABLATION}
OFFLINE = ("chunks", "chunks-published", "interleaved", "graph-cuts", "vanilla", "vanilla-unlimited")
STRATEGIES = (*ENGINE_OPTIONS, *OFFLINE)


@dataclass(frozen=True)
class Task:
    """What every strategy is given: shots in order of arrival, a backbone, a descriptor, and a folder to work in."""

    shots: Sequence[Shot]
    load: Callable[[Shot], WorkingImage]
    backbone: Backbone
    describer: Describer
    work: Path  # empty or missing
    options: Mapping[str, object] = field(default_factory=dict)  # of the engine, on top of the strategy's own


@dataclass(frozen=True)
class Placement:
    """Where a strategy put the cameras, and at what price."""

    map_from_cam: Mapping[int, Rigid3]  # by order of arrival
    calls: int
    inferred: int  # images over all calls
    largest: int  # images in one call
    seconds: float
    passes: tuple[GraphPass, ...] = ()  # of the pose graph, engine only
    note: str = ""  # why nothing was placed


class Counting:
    """A backbone that counts what it is asked for."""

    def __init__(self, inner: Backbone) -> None:
        self._inner = inner
        self.sizes: list[int] = []
        if isinstance(inner, ExtractsFeatures):
            self.extract_features = inner.extract_features

    @property
    def spec(self) -> BackboneSpec:
        """Of the backbone within."""
        return self._inner.spec

    def reconstruct(
        self, subset: Subset, images: Mapping[int, WorkingImage], calibrations: Mapping[str, Camera]
    ) -> LocalModel | Rejection:
        """Pass the subset on."""
        self.sizes.append(len(subset.members))
        return self._inner.reconstruct(subset, images, calibrations)


def place(strategy: str, task: Task) -> Placement:
    """Run one strategy of `STRATEGIES`."""
    backbone = Counting(task.backbone)
    began = time.perf_counter()
    passes: tuple[GraphPass, ...] = ()
    note = ""
    poses: Mapping[int, Rigid3]
    if strategy in ENGINE_OPTIONS:
        poses, passes = _place_online(task, backbone, Options.from_flat({**ENGINE_OPTIONS[strategy], **task.options}))
    elif strategy == "vanilla" and len(task.shots) > JOINT_LIMIT:
        poses, note = {}, f"out of memory: a joint inference holds {JOINT_LIMIT} images"
    else:
        poses = _place_offline(strategy, task, backbone)
    return Placement(
        map_from_cam=poses,
        calls=len(backbone.sizes),
        inferred=sum(backbone.sizes),
        largest=max(backbone.sizes, default=0),
        seconds=time.perf_counter() - began,
        passes=passes,
        note=note,
    )


def _place_online(task: Task, backbone: Backbone, options: Options) -> tuple[dict[int, Rigid3], tuple[GraphPass, ...]]:
    engine = Engine(task.work, options, backbone, task.describer, task.load)
    engine.add_all(task.shots)
    engine.finish()
    state = engine.state
    return {i: state.map_from_cam(i) for i in state.frames}, graph_passes(engine.store)


def _place_offline(strategy: str, task: Task, backbone: Backbone) -> dict[int, Rigid3]:
    images = ImageCache(dict(enumerate(task.shots)), task.load)
    calibrations: dict[str, Camera] = {}

    def infer(members: Sequence[int]) -> LocalModel | None:
        model = backbone.reconstruct(Subset(references=(), new=tuple(members)), images, calibrations)
        if isinstance(model, Rejection):
            return None
        for key, camera in model.calibrations.items():
            calibrations.setdefault(key, camera)
        return model

    if strategy.startswith("vanilla"):
        model = infer(range(len(images)))
        return {i: view.local_from_cam for i, view in model.views.items()} if model else {}
    task.describer.fit({i: images[i] for i in range(min(len(images), Options().selection.seed_size))})
    index = RetrievalIndex()
    for number in range(len(images)):
        index.add(number, task.describer.describe(number, images[number]))
    given = (len(images), index, infer, backbone.spec.confidence_threshold)
    if strategy.startswith("chunks"):
        return place_chunks(*given, PUBLISHED if strategy == "chunks-published" else FITTING)
    return (place_interleaved if strategy == "interleaved" else place_parts)(*given, JOINT_LIMIT)
