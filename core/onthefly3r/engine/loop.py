"""The online engine: images in, a validated and drift-free map out (the paper's pipeline, Sec. III)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..backbones.base import Backbone, ExtractsFeatures, Interruptible
from ..earth.blockadjust import adjust_block
from ..errors import Cancelled, OnTheFly3RError, PhotographError
from ..geometry.arrays import Float
from ..geometry.transforms import Sim3
from ..graph.gpsprior import GpsTie, gps_disagreement, pose_priors, tie_to_positions
from ..graph.posegraph import default_solver, optimise_frames, optimise_submaps
from ..graph.solver import PoseGraphSolver
from ..intake.cache import ImageCache
from ..map.new_frame import new_frame
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..protocol import Progress, ProgressCallback
from ..records import FrameEdge, GpsFix, LocalModel, Rejection, Shot, Submap, Subset, WorkingImage
from ..registration.contextual import incompatible_references
from ..registration.references import scene_spacing
from ..registration.register import Registration, check_seed, frame_edges, register
from ..selection.describer import Describer
from ..selection.frontier import Frontier, orphans
from ..selection.index import RetrievalIndex
from ..selection.proposals import plane_position, propose_references
from ..selection.retry import RetryQueue
from ..selection.seed import choose_seed
from ..selection.subset import build_subset, fixed_subset
from ..stopwatch import Stopwatch

# Photographs between two steps of progress, per thread and at most: the image cache must hold them all.
READ_AT_ONCE, MOST_READ_AT_ONCE = 8, 48
SEED_ATTEMPTS = 5
MIN_SEED_SHARE = 0.5
# Drift is removed when it shows, or when the map has grown by this share, but not before it has so many new submaps:
# where little is new, chance moves a map as much as what is learnt, and may move it away from the truth.
SETTLE_EVERY = 20
SETTLE_GROWTH = 1.0
DRIFT_SHOWS = 2.2  # times the usual residual: references that far apart were placed along different ways


class Engine:
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
        self.options = options
        self.shots: dict[int, Shot] = {}
        self.rejections: dict[int, Rejection] = {}
        self.stopwatch = Stopwatch()
        self.store = Store(work)
        self.state = MapState(self.store)
        self.backbone_calls = 0
        self.batch_sizes: list[int] = []
        self._residuals: list[float] = []  # of all alignments, map units
        self._drift_shows = False
        self.pruned_references = 0
        self.refinement: Mapping[str, Any] = {}
        self.warnings: list[str] = []
        self._backbone = backbone
        self._describer = describer
        self._images = ImageCache(self.shots, load, work / "features")  # beside what else can be made again
        self._progress = progress
        self._cancel = cancel
        self._index = RetrievalIndex()
        self._pending: list[int] = []  # described only once there are enough to learn from
        self._waiting: list[int] = []
        self._frontier = Frontier()
        self._retry = RetryQueue(options.registration.max_retries if options.registration.validation else 0)
        self._refused_seeds: set[int] = set()
        self._described = False
        self._origin: GpsFix | None = None
        self._settled_submaps = 0
        self._tie: GpsTie | None = None
        self._doubted: dict[int, Float] = {}  # where an image landed that its position does not confirm
        self._solver: PoseGraphSolver | None = None
        if isinstance(backbone, Interruptible):
            backbone.interrupt_with(self._stop_if_cancelled)

    @property
    def backbone_name(self) -> str:
        """Name and version of the local reconstructor."""
        return f"{self._backbone.spec.name} {self._backbone.spec.version}"

    @property
    def _validates_queries(self) -> bool:
        return self.options.registration.validation and self.options.registration.validate_queries

    @property
    def retries(self) -> dict[int, int]:
        """How often each image was tried again that ever was."""
        return self._retry.retries

    def details(self) -> dict[str, Any]:
        """Return figures of the run for the report."""
        return {
            "submaps": float(len(self.state.map_from_submap)),
            "sightings": float(len(self.state.sightings)),
            "backbone_calls": float(self.backbone_calls),
            "mean_batch": sum(self.batch_sizes) / len(self.batch_sizes) if self.batch_sizes else 0.0,
            "pruned_references": float(self.pruned_references),
            "retried_images": float(sum(count > 0 for count in self.retries.values())),
            **self.refinement,
        }

    # ------------------------------------------------------------------ images in

    def add(self, shot: Shot) -> None:
        """Take one more shot and go as far as the images at hand allow."""
        self.add_all([shot])
        self.advance()

    def advance(self) -> None:
        """Go as far as the images at hand allow."""
        self._advance(finishing=False)

    def add_all(self, shots: Iterable[Shot]) -> None:
        """Take several shots that are there already: the seed may be chosen among all of them."""
        new = {len(self.shots) + i: shot for i, shot in enumerate(shots)}
        self.shots.update(new)
        threads = self.options.backbone.threads or os.cpu_count() or 1
        at_once = min(READ_AT_ONCE * threads, MOST_READ_AT_ONCE)
        with ThreadPoolExecutor(threads) as pool:
            for start in range(0, len(new), at_once):
                self._checkpoint("reading photographs", start, len(new))
                self._prepare(list(new)[start : start + at_once], pool)
                self._describe_pending(force=False)  # while the images are at hand

    def finish(self) -> None:
        """Place what is still waiting, retry what was set aside, and remove the drift."""
        self._describe_pending(force=True)
        if not self.state.frames:
            self._refused_seeds.clear()  # now that all images are there
        self._advance(finishing=True)
        self._settle()
        if self.options.pose_graph.refine and self.state.frames:
            self._refine()

    def _prepare(self, new: list[int], pool: Executor) -> None:
        """Decode images, and extract what backbone and descriptor want of them, which may be the same."""
        with self.stopwatch.stage("features"):
            images: dict[int, WorkingImage] = {}
            for index, found in zip(new, pool.map(self._read, new), strict=True):
                if isinstance(found, PhotographError):
                    self._reject((index,), "intake", found.reason, {})
                else:
                    images[index] = found
            for part in (self._backbone, self._describer):
                if isinstance(part, ExtractsFeatures):
                    part.extract_features(images)
        self._pending += images

    def _read(self, index: int) -> WorkingImage | PhotographError:
        try:
            return self._images[index]
        except PhotographError as error:
            return error

    def _describe_pending(self, force: bool) -> None:
        seed_size = self.options.selection.seed_size
        if not self._pending or (not self._described and not force and len(self._pending) < seed_size):
            return
        with self.stopwatch.stage("retrieval"):
            if not self._described:
                self._describer.fit({i: self._images[i] for i in self._pending[:seed_size]})
                self._described = True
            for index in self._pending:
                fix = self.shots[index].gps
                self._origin = self._origin or fix
                position = plane_position(fix, self._origin) if fix and self._origin else None
                self._index.add(index, self._describer.describe(index, self._images[index]), position)
        self._frontier.add(self._pending, self._index)
        self._waiting += self._pending
        self._pending = []

    # ------------------------------------------------------------------ the loop

    def _advance(self, finishing: bool) -> None:
        if not self.state.frames and not self._start(finishing):
            return
        while True:
            self._waiting = self._retry.take_ready(finishing and not self._waiting) + self._waiting
            if not self._waiting or not (finishing or len(self._waiting) >= self.options.selection.batch_size):
                return
            subset = self._next_subset()
            full = len(subset.new) >= self.options.selection.batch_size
            if not (finishing or full or len(self._waiting) >= self.options.selection.lookahead):
                return  # images that fill the batch may still arrive
            self._step(subset)
            self._checkpoint("reconstructing", len(self.state.frames), len(self.shots))

    def _start(self, finishing: bool) -> bool:
        """Find a seed that hangs together (Eq. 1, Eq. 3); return whether there is a map now."""
        size = self.options.selection.seed_size
        while self._waiting and (finishing or len(self._waiting) >= size):
            if not finishing and len(self._refused_seeds) >= SEED_ATTEMPTS * len(self._waiting) // size:
                return False  # more images make more attempts worth while
            # Attempts after the first few are smaller: a small group may hang together where a large one does not.
            wanted = size if len(self._refused_seeds) < SEED_ATTEMPTS else max(5, size // 3)
            seed = choose_seed(self._waiting, self._index.similarities, wanted, frozenset(self._refused_seeds))
            if len(seed) < 3 or len(self._refused_seeds) > 3 * SEED_ATTEMPTS:
                if not finishing:
                    return False
                for index in self._waiting:
                    self._reject(
                        (index,),
                        "seed",
                        "no group of images hangs together",
                        {"attempts": float(len(self._refused_seeds))},
                    )
                self._waiting = []
                return False
            self._checkpoint("starting the map", 0, len(self.shots))
            if self._commit_seed(seed):
                self._waiting = [i for i in self._waiting if i not in self.state.frames]
                return True
            self._refused_seeds.add(seed[0])
        return False

    def _commit_seed(self, seed: tuple[int, ...]) -> bool:
        subset, model = self._infer(Subset(references=(), new=seed))
        if isinstance(model, Rejection):
            return False
        threshold = self._backbone.spec.confidence_threshold
        refused = check_seed(model.views, threshold) if self._validates_queries else {}
        good = [i for i in subset.new if i in model.views and i not in refused]
        spacing = scene_spacing({i: model.views[i] for i in good}, threshold)
        seen = len(subset.new) - len(model.left_out)
        if len(good) < max(3, MIN_SEED_SHARE * seen) or not spacing > 0.0:
            return False
        self.state.set_spacing(spacing)
        self._commit(model, Submap(0, Sim3(), (), ()), good)
        self._settle()
        return True

    def _step(self, subset: Subset) -> None:
        taken = set(subset.new)
        self._waiting = [i for i in self._waiting if i not in taken]
        if len(subset.references) < self.options.registration.min_references:
            numbers = {"references": float(len(subset.references))}
            self._set_aside_images(Rejection(subset.new, "retrieval", "no similar images in the map", numbers))
            return
        subset, outcome, model = self._reconstruct_and_register(subset)
        if isinstance(outcome, Rejection) or model is None:
            if isinstance(outcome, Rejection):
                self._set_aside_images(outcome)
            return
        self.pruned_references += len(outcome.pruned)
        outcome = self._without_orphans(outcome, subset)
        if isinstance(outcome, Rejection):
            self._set_aside_images(outcome)
            return
        number = self.state.next_submap()
        extra: tuple[FrameEdge, ...] = ()
        if self.options.pose_graph.pose_graph == "se3":
            similar = self._index.top(outcome.accepted, self.options.selection.references)
            retrieved = {index: [n.index for n in found] for index, found in similar.items()}
            extra = frame_edges(model, outcome, retrieved, self.state)
        submap = Submap(number, outcome.alignment.map_from_local, (), outcome.sightings, extra)
        self.batch_sizes.append(len(outcome.accepted))
        self._residuals.append(outcome.alignment.residual)
        self._drift_shows |= outcome.alignment.residual > DRIFT_SHOWS * float(np.median(self._residuals))
        self._commit(model, submap, outcome.accepted)
        for refused in outcome.refused:
            self._set_aside_images(refused)
        if self._has_drift() and self.options.pose_graph.pose_graph != "se3":
            self._settle()

    def _next_subset(self) -> Subset:
        options = self.options.selection
        with self.stopwatch.stage("retrieval"):
            if options.batching == "fixed":
                return fixed_subset(self._waiting, self.state.last_accepted(options.subset_references), options)
            window = self._waiting[: options.batch_size]
            if options.lookahead > 1:
                window = self._index.best_tied(self._waiting, max(options.lookahead, options.batch_size))
            neighbours = propose_references(window, self._index, options.references, options.gps_candidates)
            similarity = self._index.similarities(window, window)
            row = {index: i for i, index in enumerate(window)}

            def similar(a: int, b: int) -> float:
                return float(similarity[row[a], row[b]])

            if options.lookahead == 1:
                return build_subset(window, neighbours, similar, options)
            references = sorted({n.index for found in neighbours.values() for n in found})
            support = self._frontier.support(window, references, self._index)
            return build_subset(window, neighbours, similar, options, support)

    def _reconstruct_and_register(self, subset: Subset) -> tuple[Subset, Registration | Rejection, LocalModel | None]:
        """Infer, register and validate; with context tokens, drop incompatible references and infer once more.

        The subset that comes back lacks the images that are waiting again, or are gone.
        """
        subset, model = self._infer(subset)
        if isinstance(model, Rejection):
            return subset, model, None
        subset = self._put_back(subset, model.left_out)
        outcome = self._register(model, subset)
        if isinstance(outcome, Rejection) and self._backbone.spec.has_tokens and self.options.registration.validation:
            minimum = self.options.registration.min_references
            dropped = incompatible_references(subset, model.views, minimum)
            if dropped:
                subset = replace(subset, references=tuple(i for i in subset.references if i not in dropped))
                subset, again = self._infer(subset)
                if isinstance(again, LocalModel):
                    subset = self._put_back(subset, again.left_out)
                    return subset, self._register(again, subset), again
        return subset, outcome, model

    def _without_orphans(self, outcome: Registration, subset: Subset) -> Registration | Rejection:
        """Refuse the new images whose own references were pruned: nothing kept speaks for where they are."""
        if not self._validates_queries:
            return outcome
        least = self.options.selection.min_shared_references
        lost = [i for i in orphans(subset, outcome.alignment.references, self._index, least) if i in outcome.accepted]
        refused = [Rejection((i,), "queries", "the references most like it were pruned", {}) for i in lost]
        accepted = tuple(i for i in outcome.accepted if i not in lost)
        if not accepted:
            return Rejection(subset.new, "queries", "the references most like the new images were pruned", {})
        return replace(outcome, accepted=accepted, refused=(*outcome.refused, *refused))

    def _put_back(self, subset: Subset, left_out: tuple[int, ...]) -> Subset:
        """Queue the images first in line that memory had no room for; return the subset without them."""
        self._waiting = [*left_out, *self._waiting]
        return replace(subset, new=tuple(i for i in subset.new if i not in left_out))

    def _infer(self, subset: Subset) -> tuple[Subset, LocalModel | Rejection]:
        """Return the local model of a subset without the photographs that cannot be read any more, and that subset."""
        while subset.new:
            self.backbone_calls += 1
            try:
                with self.stopwatch.stage("backbone"):
                    return subset, self._backbone.reconstruct(subset, self._images, self.state.calibrations)
            except PhotographError as error:
                gone = tuple(i for i in subset.members if self.shots[i].name == error.image)
                if not gone:
                    raise
                self._reject(tuple(i for i in gone if i in subset.new), "intake", error.reason, {})
                self._waiting = [i for i in self._waiting if i not in gone]
                references, new = (tuple(i for i in part if i not in gone) for part in (subset.references, subset.new))
                subset = Subset(references, new)
        return subset, Rejection((), "intake", "no photograph of the subset can be read any more", {})

    def _register(self, model: LocalModel, subset: Subset) -> Registration | Rejection:
        with self.stopwatch.stage("registration"):
            threshold = self._backbone.spec.confidence_threshold
            check = self._far_from_position if self._tie and self.options.registration.gps_check else None
            return register(model, subset, self.state, threshold, self.options.registration, check)

    def _far_from_position(self, index: int, centre: Float, references: Mapping[int, Float]) -> float:
        """Positions ask for a second opinion: two reconstructions that agree on another place outvote them."""
        disagreement = gps_disagreement(index, centre, references, self.shots, self._tie) if self._tie else 0.0
        if disagreement > 1.0:
            before = self._doubted.get(index)
            self._doubted[index] = centre
            allowed = self.options.registration.alpha * self.state.spacing
            if before is not None and np.linalg.norm(centre - before) < allowed:
                return 0.0
        return disagreement

    def _commit(self, model: LocalModel, submap: Submap, accepted: Iterable[int]) -> None:
        with self.stopwatch.stage("map"):
            threshold = self._backbone.spec.confidence_threshold
            points = self.options.registration.reference_points
            frames = [new_frame(i, submap.number, model.views[i], self._images[i], threshold, points) for i in accepted]
            placed_frames = tuple(new.frame for new in frames)
            complete = replace(submap, frames=placed_frames, calibrations=model.calibrations)
            self.state.commit(complete, frames, model.observations)
        placed = [new.frame.index for new in frames]
        for index in placed:
            self.rejections.pop(index, None)
        self._index.accept(placed)
        self._retry.placed(placed, self._index)

    # ------------------------------------------------------------------ rejection and retry

    def _set_aside_images(self, rejection: Rejection) -> None:
        """Keep rejected images for later: the map may grow around them."""
        self._reject(rejection.images, rejection.stage, rejection.reason, rejection.numbers)
        for index in rejection.images:
            self._retry.set_aside(index, self._index, self.options.selection.references)

    def _reject(self, images: tuple[int, ...], stage: str, reason: str, numbers: Mapping[str, float]) -> None:
        for index in images:
            self.rejections[index] = Rejection((index,), stage, reason, numbers)

    # ------------------------------------------------------------------ drift

    def _has_drift(self) -> bool:
        """Return whether there is more to gain from a pass of the pose graph than chance can spoil."""
        submaps = len(self.state.map_from_submap)
        grown = submaps - self._settled_submaps
        return grown >= SETTLE_EVERY and (self._drift_shows or grown >= SETTLE_GROWTH * self._settled_submaps)

    def _settle(self) -> None:
        """Tie the map to the positions as it is now, and remove its drift."""
        self._drift_shows = False
        graph = self.options.pose_graph
        with self.stopwatch.stage("pose graph"), self._optional("the pose graph"):
            self._settled_submaps = len(self.state.map_from_submap)
            if graph.gps_priors or self.options.registration.gps_check:
                self._tie = tie_to_positions(self.state, self.shots, self.options.georeference)
            if graph.pose_graph == "none" or self._settled_submaps < 2:
                return
            self._solver = self._solver or default_solver()
            if graph.pose_graph == "se3":
                optimise_frames(self.state, self._solver)
                return
            priors = pose_priors(self.state, self._tie, self.shots) if self._tie and graph.gps_priors else []
            optimise_submaps(self.state, self._solver, priors)

    def _refine(self) -> None:
        with self.stopwatch.stage("refinement"):
            self._checkpoint("refining the cameras", 0, 1)
            with self._optional("the refinement"):
                adjusted = adjust_block(self.state, self.store.stream_observations(), self.shots, self.options)
                if adjusted is not None:
                    self.state.move_refined(adjusted.refinement.map_from_submap, adjusted.refinement.calibrations)
                    self.refinement = adjusted.refinement.notes
                    self.warnings += adjusted.warnings
                    if adjusted.tie is not None:
                        self.state.set_tie(adjusted.tie)

    @contextlib.contextmanager
    def _optional(self, stage: str) -> Iterator[None]:
        """Let a stage that makes the map better fail: solvers raise errors of their own, and the map is worth more."""
        try:
            yield
        except (OnTheFly3RError, OSError):
            raise
        except Exception as error:
            self.warnings.append(
                f"{stage} failed ({type(error).__name__}: {error}): the cameras are as they were before it, "
                "less accurate than they could be"
            )

    def _stop_if_cancelled(self) -> None:
        if self._cancel is not None and self._cancel():
            raise Cancelled("stopped on request; run again to start anew")

    def _checkpoint(self, stage: str, done: int, total: int) -> None:
        self._stop_if_cancelled()
        if self._progress is None:
            return
        placed, rejected = len(self.state.frames), len(self.rejections)
        waiting = len(self.shots) - placed - rejected
        elapsed = self.stopwatch.total_s
        eta_s = elapsed / placed * waiting if placed and stage == "reconstructing" else None
        self._progress(Progress(stage, done, total, placed, rejected, waiting, eta_s))
