"""The online engine: images in, a validated and drift-free map out (the paper's pipeline, Sec. III)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

from ..backbones.base import Backbone, ExtractsFeatures
from ..errors import InputError, PhotographError
from ..map.state import MapState
from ..options import Options
from ..protocol import Progress, ProgressCallback
from ..records import GpsFix, Rejection, Shot, WorkingImage
from ..selection.described import DescribedImages
from ..selection.describer import Describer, Learns
from ..selection.nearcopies import small_picture
from ..selection.proposals import plane_position
from .drift import Drift
from .joining import Joins
from .memory import StepJournal
from .seeding import Seeds
from .stepping import Steps
from .workbench import Workbench

# Photographs between two steps of progress, per thread and at most: the image cache must hold them all.
READ_AT_ONCE, MOST_READ_AT_ONCE = 8, 48

# Photographs may come; all are there; all that can be are placed; the drift is removed; the cameras are refined.
Phase = Literal["arriving", "placing", "placed", "optimised", "refined"]


class Engine(Workbench):
    """Takes shots one by one or all at once, and places them in a map that only validated images may touch.

    Args:
        work: folder for chunks, journal and features.
        options: of the whole run.
        backbone: the local reconstructor.
        describer: the retrieval descriptor.
        load: decodes a shot to working size; raises `PhotographError`.
        progress: told after every step.
        cancel: asked before every step; true ends the run with `Cancelled`.
    """

    def __init__(
        self,
        work: Path,
        options: Options,
        backbone: Backbone,
        describer: Describer,
        load: Callable[[Shot], WorkingImage],
        progress: ProgressCallback | None = None,
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        super().__init__(work, options, backbone, load, cancel)
        self.drift = Drift(self)
        self.joins = Joins(self, self.drift, self._checkpoint)
        self.seeds = Seeds(self, self.drift, self._checkpoint)
        self.steps = Steps(self, self.drift, self.joins)
        self._describer = describer
        self._progress = progress
        self.phase: Phase = "arriving"
        self.read = 0  # shots that were looked at, the first ones
        self.pending: list[int] = []  # described only once there are enough to learn from
        self.fitted: list[int] = []  # what the descriptor learnt from
        self.described: list[int] = []
        self._made = DescribedImages(work / "features")
        self._origin: GpsFix | None = None
        self._to_recall = False  # what is described, by an earlier process
        self._steps = StepJournal(self.store)

    @property
    def backbone_name(self) -> str:
        """Name and version of the local reconstructor."""
        return f"{self.backbone.spec.name} {self.backbone.spec.version}"

    @property
    def retries(self) -> dict[int, int]:
        """How often each image was tried again that ever was."""
        return self.retry.retries

    @property
    def refinement(self) -> Mapping[str, Any]:
        """Figures of the refinement of the largest fragment."""
        return self.drift.refinement

    def details(self) -> dict[str, Any]:
        """Return figures of the run for the report."""
        sizes = self.steps.memory.batch_sizes
        return {
            "submaps": float(len(self.state.map_from_submap)),
            "sightings": float(len(self.state.sightings)),
            "fragments": float(len(self.state.fragments())),
            "joins": float(len(self.joins.memory.joined)),
            "joins_refused": float(self.joins.memory.refused),
            "joins_undone": float(self.joins.memory.undone),
            "backbone_calls": float(self.backbone_calls),
            "mean_batch": sum(sizes) / len(sizes) if sizes else 0.0,
            "pruned_references": float(self.steps.memory.pruned_references),
            "weakly_tied": float(self.steps.memory.weakly_tied),
            "retried_images": float(sum(count > 0 for count in self.retries.values())),
            **self.refinement,
        }

    # ------------------------------------------------------------------ images in

    def add(self, shot: Shot) -> None:
        """Take one more shot and go as far as the images at hand allow."""
        self.add_all([shot])
        self.advance()

    def add_all(self, shots: Iterable[Shot]) -> None:
        """Take several shots that are there already: the seed may be chosen among all of them."""
        self._recall_images()
        new = {len(self.shots) + i: shot for i, shot in enumerate(shots)}
        self.shots.update(new)
        self.phase = "arriving"
        threads = self.options.backbone.threads or os.cpu_count() or 1
        at_once = min(READ_AT_ONCE * threads, MOST_READ_AT_ONCE)
        with ThreadPoolExecutor(threads) as pool:
            for start in range(0, len(new), at_once):
                self._checkpoint("reading photographs", start, len(new))
                self._prepare(list(new)[start : start + at_once], pool)
                self._describe_pending(force=False)  # while the images are at hand
                self.read = min(start + at_once, len(new)) + len(self.shots) - len(new)
                self._end_step()

    def finish(self) -> None:
        """Place what is still waiting, retry what was set aside, join what can be joined, and remove the drift.

        What an earlier process did of it is not done again.
        """
        if self.phase == "arriving":
            self._recall_images()
            self._describe_pending(force=True)
            if not self.state.frames:
                self.seeds.refused.clear()  # now that all images are there
            self._end_step("placing")
        if self.phase == "placing":
            self.advance(finishing=True)
            self._end_step("placed")
        if self.phase == "placed":
            for fragment in self.state.fragments():
                self.drift.optimise(fragment)
            self._end_step("optimised")
        if self.phase == "optimised":
            if self.options.pose_graph.refine and self.state.frames:
                self._checkpoint("refining the cameras", 0, 1)
                self.drift.refine()
            self._end_step("refined")

    def take_up(self, shots: Sequence[Shot]) -> Sequence[Shot]:
        """Go on from what the work folder holds of a run with these shots; return those that are to be added still.

        Raises `InputError` when it was left by another release or is damaged.
        """
        if not self.store.has_journal:
            return shots  # it ended before its first step
        steps = self.store.rewind()
        if not steps:
            raise InputError("it was made by an older release, which left too little to go on from")
        self.state = MapState.load(self.store)
        self._steps.recall(self, steps)
        self.shots.update(enumerate(shots[: self.read]))
        self._to_recall = bool(self.fitted)
        return shots[self.read :]

    def _recall_images(self) -> None:
        """Know again what an earlier process described, from disk where it is there."""
        if not self._to_recall:
            return
        self._to_recall = False
        with self.stopwatch.stage("retrieval"):
            self._recall_learnt()
            self._index(self.described)
            self.index.accept(list(self.state.frames))

    def _recall_learnt(self) -> None:
        learnt = self._made.load_learnt()
        if isinstance(self._describer, Learns) and learnt is not None:
            with contextlib.suppress(KeyError):
                self._describer.recall(learnt)
                return
        self._describer.fit({i: self.images[i] for i in self.fitted})

    def _end_step(self, phase: Phase | None = None) -> None:
        """Write down what decides the next step; what comes before is not done again by a run that goes on."""
        self.phase = phase or self.phase
        self._steps.note(self)

    def _prepare(self, new: list[int], pool: Executor) -> None:
        """Decode images, and extract what backbone and descriptor want of them, which may be the same."""
        with self.stopwatch.stage("features"):
            images: dict[int, WorkingImage] = {}
            for index, found in zip(new, pool.map(self._read, new), strict=True):
                if isinstance(found, PhotographError):
                    self.reject(Rejection((index,), "intake", found.reason))
                else:
                    images[index] = found
            for part in (self.backbone, self._describer):
                if isinstance(part, ExtractsFeatures):
                    part.extract_features(images)
        self.pending += images

    def _read(self, index: int) -> WorkingImage | PhotographError:
        try:
            return self.images[index]
        except PhotographError as error:
            return error

    def _describe_pending(self, force: bool) -> None:
        seed_size = self.options.selection.seed_size
        if not self.pending or (not self.fitted and not force and len(self.pending) < seed_size):
            return
        with self.stopwatch.stage("retrieval"):
            if not self.fitted:
                self.fitted = self.pending[:seed_size]
                self._describer.fit({i: self.images[i] for i in self.fitted})
                if isinstance(self._describer, Learns):
                    self._made.keep_learnt(self._describer.learnt())
            self._index(self.pending)
        self.described += self.pending
        self.waiting += self.pending
        self.pending = []

    def _index(self, images: Sequence[int]) -> None:
        """Let images be compared with each other."""
        for index in images:
            fix = self.shots[index].gps
            self._origin = self._origin or fix
            position = plane_position(fix, self._origin) if fix and self._origin else None
            made = self._made.load(index)
            if made is None:
                image = self.images[index]
                made = self._describer.describe(index, image), small_picture(image.rgb)
                self._made.keep(index, *made)
            descriptor, small = made
            self.index.add(index, descriptor, position)
            self.near_copies.keep(index, small)
        self.frontier.add(images, self.index)

    # ------------------------------------------------------------------ the loop

    def advance(self, finishing: bool = False) -> None:
        """Go as far as the images at hand allow; at the end, place whatever can be placed."""
        self._recall_images()
        if not self.state.frames:
            if not self.seeds.begin_map(finishing):
                return
            self._end_step()
        options = self.options.selection
        while True:
            self.waiting = self.retry.take_ready(finishing and not self.waiting) + self.waiting
            if not self.waiting and finishing and self._last_resorts():
                self._end_step()
                continue
            if not self.waiting or not (finishing or len(self.waiting) >= options.batch_size):
                return
            subset, is_firm = self.steps.next_subset()
            full = len(subset.new) >= options.batch_size
            if not (finishing or full or len(self.waiting) >= options.lookahead):
                return  # images that fill the batch may still arrive
            if is_firm or not self.seeds.begin_fragment([*self.waiting, *self.retry.aside], finishing):
                self.steps.take(subset)
            if len(self.state.fragments()) > 1 and not finishing:
                self.joins.try_all(finishing=False)
            self._end_step()
            self._checkpoint("reconstructing", len(self.state.frames), len(self.shots))

    def _last_resorts(self) -> bool:
        """Join what overlaps, begin a fragment of what was set aside; return whether there is something to try again.

        Every photograph has been tried with the map as it is.
        """
        if not self.options.registration.fragments:
            return False
        if len(self.state.fragments()) > 1 and self.joins.try_all(finishing=True):
            return True
        return self.seeds.begin_fragment(self.retry.aside, finishing=True)

    def _checkpoint(self, stage: str, done: int, total: int) -> None:
        self.stop_if_cancelled()
        if self._progress is None:
            return
        placed, rejected = len(self.state.frames), len(self.rejections)
        waiting = len(self.shots) - placed - rejected
        elapsed = self.stopwatch.total_s
        eta_s = elapsed / placed * waiting if placed and stage == "reconstructing" else None
        self._progress(Progress(stage, done, total, placed, rejected, waiting, eta_s))
