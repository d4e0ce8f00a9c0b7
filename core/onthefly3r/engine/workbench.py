"""What the parts of the engine share: the map, the images, the backbone, and what became of every photograph."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..backbones.base import Backbone, Interruptible
from ..errors import Cancelled, OnTheFly3RError, PhotographError
from ..intake.cache import ImageCache
from ..map.new_frame import new_frame
from ..map.state import MapState
from ..map.store import Store
from ..options import Options
from ..records import LocalModel, Rejection, Shot, Submap, Subset, WorkingImage
from ..selection.frontier import Frontier
from ..selection.index import RetrievalIndex
from ..selection.nearcopies import NearCopies
from ..selection.retry import RetryQueue
from ..stopwatch import Stopwatch

NAMED = 5  # neighbours that a reason names at most


class Workbench:
    """The objects that seeds, steps, joins and drift work on; see `loop.Engine` for the arguments."""

    def __init__(
        self,
        work: Path,
        options: Options,
        backbone: Backbone,
        load: Callable[[Shot], WorkingImage],
        cancel: Callable[[], bool] | None = None,
    ) -> None:
        self.options = options
        self.shots: dict[int, Shot] = {}
        self.rejections: dict[int, Rejection] = {}
        self.warnings: list[str] = []
        self.stopwatch = Stopwatch()
        self.store = Store(work)
        self.state = MapState(self.store)
        self.backbone = backbone
        self.images = ImageCache(self.shots, load, work / "features")  # beside what else can be made again
        self.index = RetrievalIndex()
        self.near_copies = NearCopies()
        self.frontier = Frontier()
        self.retry = RetryQueue(options.registration.max_retries if options.registration.validation else 0)
        self.waiting: list[int] = []  # described, in the order in which they are to be tried
        self.backbone_calls = 0
        self._cancel = cancel
        if isinstance(backbone, Interruptible):
            backbone.interrupt_with(self.stop_if_cancelled)

    @property
    def validates_queries(self) -> bool:
        """Whether new images are checked against the map, not only references."""
        return self.options.registration.validation and self.options.registration.validate_queries

    @property
    def threshold(self) -> float:
        """Confidence below which a point of the backbone is not used."""
        return self.backbone.spec.confidence_threshold

    def stop_if_cancelled(self) -> None:
        """Raise `Cancelled` when the caller asks to stop."""
        if self._cancel is not None and self._cancel():
            raise Cancelled("stopped on request")

    @contextlib.contextmanager
    def optional(self, stage: str) -> Iterator[None]:
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

    def infer(self, subset: Subset) -> tuple[Subset, LocalModel | Rejection]:
        """Return the local model of a subset without the photographs that cannot be read any more, and that subset."""
        while subset.members:
            self.backbone_calls += 1
            try:
                with self.stopwatch.stage("backbone"):
                    return subset, self.backbone.reconstruct(subset, self.images, self.state.calibrations)
            except PhotographError as error:
                gone = tuple(i for i in subset.members if self.shots[i].name == error.image)
                if not gone:
                    raise
                self.reject(Rejection(tuple(i for i in gone if i in subset.new), "intake", error.reason))
                self.waiting = [i for i in self.waiting if i not in gone]
                references, new = (tuple(i for i in part if i not in gone) for part in (subset.references, subset.new))
                if subset.new and not new:
                    break
                subset = replace(subset, references=references, new=new)
        return subset, Rejection((), "intake", "no photograph of the subset can be read any more", {})

    def commit(self, model: LocalModel, submap: Submap, accepted: Iterable[int]) -> None:
        """Add validated images of a local model to the map, and let them be retrieved."""
        with self.stopwatch.stage("map"):
            points = self.options.registration.reference_points
            frames = [
                new_frame(i, submap.number, model.views[i], self.images[i], self.threshold, points) for i in accepted
            ]
            placed_frames = tuple(new.frame for new in frames)
            complete = replace(submap, frames=placed_frames, calibrations=model.calibrations, metric=model.metric)
            self.state.commit(complete, frames, model.observations)
        placed = [new.frame.index for new in frames]
        for index in placed:
            self.rejections.pop(index, None)
        self.waiting = [i for i in self.waiting if i not in self.state.frames]
        self.index.accept(placed)
        self.retry.placed(placed, self.index)

    def set_aside(self, rejection: Rejection) -> None:
        """Keep rejected images for later: the map may grow around them."""
        self.reject(rejection)
        for index in rejection.images:
            self.retry.set_aside(index, self.index, self.options.selection.references)

    def reject(self, rejection: Rejection) -> None:
        """Note why images were refused; the neighbours that were looked at are named."""
        reason = rejection.reason + self._told(rejection.neighbours)
        for index in rejection.images:
            self.rejections[index] = Rejection((index,), rejection.stage, reason, rejection.numbers)

    def _told(self, neighbours: Mapping[int, str]) -> str:
        if not neighbours:
            return ""
        told = [f"{self.shots[i].name} {why}" for i, why in list(neighbours.items())[:NAMED]]
        more = f", and {len(neighbours) - NAMED} more" if len(neighbours) > NAMED else ""
        return f" (looked at {', '.join(told)}{more})"


def by_fragment(state: MapState, frames: Sequence[int]) -> dict[int, tuple[int, ...]]:
    """Return frames of the map by the fragment that they lie in, the fragment with most of them first."""
    found: dict[int, tuple[int, ...]] = {}
    for index in frames:
        label = state.fragment_of(index)
        found[label] = (*found.get(label, ()), index)
    return dict(sorted(found.items(), key=lambda item: -len(item[1])))
