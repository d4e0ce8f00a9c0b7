"""One step of the loop: choose a subset, reconstruct and register it, and let what was validated into the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..geometry.arrays import Float
from ..records import FrameEdge, LocalModel, Neighbour, Rejection, Submap, Subset
from ..registration.contextual import incompatible_references
from ..registration.register import Registration, frame_edges, register
from ..registration.weak import attitudes_agree
from ..selection.frontier import orphans
from ..selection.proposals import add_capture_neighbours, propose_references
from ..selection.subset import build_subset, dominant_references, fixed_subset
from .drift import Drift
from .joining import Joins
from .workbench import Workbench, by_fragment

MAX_EFFORT = 2
REFERENCES_OF_EACH = 5  # of each fragment that a subset spans
WEAK_OFFSET = 0.5  # of what a position may be off: where two references are all, it must fit better


@dataclass
class StepMemory:
    """What the steps remember beyond the map; all of it a function of the subsets so far."""

    batch_sizes: list[int] = field(default_factory=list)
    pruned_references: int = 0
    weakly_tied: int = 0
    doubted: dict[int, tuple[int, Float]] = field(default_factory=dict)  # fragment and place that a position denies
    weak: dict[int, tuple[int, Float, frozenset[int]]] = field(default_factory=dict)  # and the references, too few


class Steps:
    """Takes waiting images subset by subset."""

    def __init__(self, bench: Workbench, drift: Drift, joins: Joins) -> None:
        self._bench = bench
        self._drift = drift
        self._joins = joins
        self.memory = StepMemory()

    def next_subset(self) -> tuple[Subset, bool]:
        """Return what to reconstruct next, and whether its first image has near neighbours among the references."""
        bench = self._bench
        options = bench.options.selection
        with bench.stopwatch.stage("retrieval"):
            if options.batching == "fixed":
                accepted = bench.state.last_accepted(options.subset_references)
                return fixed_subset(bench.waiting, accepted, options), True
            window = bench.waiting[: options.batch_size]
            if options.lookahead > 1:
                window = bench.index.best_tied(bench.waiting, max(options.lookahead, options.batch_size))
            neighbours = propose_references(window, bench.index, options.references, options.gps_candidates)
            retried = [i for i in window if bench.retry.attempts.get(i)]
            if retried and options.lookahead > 1:
                add_capture_neighbours(neighbours, retried, bench.shots, bench.state.frames, bench.index)
            similarity = bench.index.similarities(window, window)
            row = {index: i for i, index in enumerate(window)}

            def similar(a: int, b: int) -> float:
                return float(similarity[row[a], row[b]])

            if options.lookahead == 1:
                return build_subset(window, neighbours, similar, options), True
            references = sorted({n.index for found in neighbours.values() for n in found})
            support = bench.frontier.support(window, references, bench.index)
            subset = build_subset(window, neighbours, similar, options, support)
            first = dominant_references(subset.new[:1], neighbours, options.subset_references)
            effort = min(MAX_EFFORT, max(bench.retry.attempts.get(i, 0) for i in subset.new))
            subset = replace(subset, references=self._of_two_fragments(subset, neighbours), effort=effort)
            return subset, support(subset.new[:1], first)

    def _of_two_fragments(self, subset: Subset, neighbours: Mapping[int, list[Neighbour]]) -> tuple[int, ...]:
        """Return the references of a subset, enough of each where they lie in two fragments: it may tie them."""
        parts = by_fragment(self._bench.state, subset.references)
        if len(parts) < 2:
            return subset.references
        chosen: list[int] = []
        for label in list(parts)[:2]:
            own = {q: [n for n in neighbours[q] if self._bench.state.fragment_of(n.index) == label] for q in subset.new}
            chosen += dominant_references(subset.new, own, REFERENCES_OF_EACH)
        return tuple(chosen)

    def take(self, subset: Subset) -> None:
        """Reconstruct a subset and let its images into the map, or set them aside with the reason."""
        bench, options = self._bench, self._bench.options.registration
        bench.waiting = [i for i in bench.waiting if i not in set(subset.new)]
        weakly = options.fragments and subset.effort > 0
        least = min(2, options.min_references) if weakly else options.min_references
        if len(subset.references) < least:
            numbers = {"references": float(len(subset.references))}
            bench.set_aside(Rejection(subset.new, "retrieval", "no similar images in the map", numbers))
            return
        subset, model, found = self._reconstruct_and_register(subset)
        fitting = {label: r for label, r in found.items() if isinstance(r, Registration)}
        if not isinstance(model, LocalModel) or not fitting:
            refused = next(iter(found.values()))
            if isinstance(refused, Rejection):
                bench.set_aside(refused)
            return
        home = next(iter(fitting))
        self.memory.pruned_references += len(fitting[home].pruned)
        kept = {i for registration in fitting.values() for i in registration.alignment.references}
        own = self._without_orphans(fitting[home], subset, kept)
        if isinstance(own, Rejection):
            bench.set_aside(own)
            return
        self._let_in(subset, model, home, own, {label: r for label, r in fitting.items() if label != home})

    def _let_in(
        self, subset: Subset, model: LocalModel, home: int, own: Registration, others: dict[int, Registration]
    ) -> None:
        bench = self._bench
        number = bench.state.next_submap()
        extra: tuple[FrameEdge, ...] = ()
        if bench.options.pose_graph.pose_graph == "se3":
            similar = bench.index.top(own.accepted, bench.options.selection.references)
            retrieved = {index: [n.index for n in found] for index, found in similar.items()}
            extra = frame_edges(model, own, retrieved, bench.state)
        sightings = own.sightings
        confirmed = []
        for label, other in others.items():
            verdict = self._joins.examine(home, own, label, other)
            if verdict != "refused":
                sightings += other.sightings
            if verdict == "confirmed":
                confirmed.append(label)
        submap = Submap(number, own.alignment.map_from_local, (), sightings, extra, fragment=home)
        self.memory.batch_sizes.append(len(own.accepted))
        self._drift.note(home, own.alignment.residual)
        bench.commit(model, submap, own.accepted)
        for refused in own.refused:
            bench.set_aside(refused)
        for label in confirmed:
            self._joins.make(label, home, own, others[label], number)
        here = bench.state.fragment_of_submap[number]
        self._joins.heard(here, subset.references, own.alignment.references if not confirmed else subset.references)
        here = bench.state.fragment_of_submap[number]
        if self._drift.is_worth_removing(here) and bench.options.pose_graph.pose_graph != "se3":
            self._drift.optimise(here)

    def _reconstruct_and_register(
        self, subset: Subset
    ) -> tuple[Subset, LocalModel | None, dict[int, Registration | Rejection]]:
        """Infer, register to each fragment that the references lie in, and validate.

        With context tokens, drop incompatible references and infer once more where nothing fits. The subset that
        comes back lacks the images that are waiting again, or are gone.
        """
        bench = self._bench
        subset, model = bench.infer(subset)
        if isinstance(model, Rejection):
            return subset, None, {-1: model}
        subset = self._put_back(subset, model.left_out)
        found = self._register(model, subset)
        refused = not any(isinstance(outcome, Registration) for outcome in found.values())
        if refused and bench.backbone.spec.has_tokens and bench.options.registration.validation:
            minimum = bench.options.registration.min_references
            dropped = incompatible_references(subset, model.views, minimum)
            if dropped:
                subset = replace(subset, references=tuple(i for i in subset.references if i not in dropped))
                subset, again = bench.infer(subset)
                if isinstance(again, LocalModel):
                    subset = self._put_back(subset, again.left_out)
                    return subset, again, self._register(again, subset)
        return subset, model, found

    def _put_back(self, subset: Subset, left_out: tuple[int, ...]) -> Subset:
        """Queue the images first in line that memory had no room for; return the subset without them."""
        self._bench.waiting = [*left_out, *self._bench.waiting]
        return replace(subset, new=tuple(i for i in subset.new if i not in left_out))

    def _register(self, model: LocalModel, subset: Subset) -> dict[int, Registration | Rejection]:
        """Return the outcome in each fragment that the references lie in, that of most of them first."""
        bench, found = self._bench, {}
        with bench.stopwatch.stage("registration"):
            for label, references in by_fragment(bench.state, subset.references).items():
                found[label] = self._register_to(model, replace(subset, references=references), label)
        return found

    def _register_to(self, model: LocalModel, subset: Subset, fragment: int) -> Registration | Rejection:
        bench, options = self._bench, self._bench.options.registration
        part = bench.state.part(fragment)

        def far_from_position(index: int, centre: Float, references: Mapping[int, Float]) -> float:
            return self._far_from_position(fragment, index, centre, references)

        check = far_from_position if fragment in self._drift.tie_of and options.gps_check else None
        outcome = register(model, subset, part, bench.threshold, options, check)
        if isinstance(outcome, Registration) or not (options.fragments and options.validation and subset.effort):
            return outcome
        if outcome.stage != "references" or not outcome.numbers.get("references", 0.0) >= 2.0:
            return outcome
        weak = register(model, subset, part, bench.threshold, replace(options, min_references=2), check)
        return outcome if isinstance(weak, Rejection) else self._with_second_opinion(model, weak, fragment, outcome)

    def _with_second_opinion(
        self, model: LocalModel, weak: Registration, fragment: int, outcome: Rejection
    ) -> Registration | Rejection:
        """Return a registration by two references with those images only that something else confirms."""
        confirmed, refused = [], list(weak.refused)
        state, kept = self._bench.state, frozenset(weak.alignment.references)
        centres = {i: state.map_from_cam(i).translation for i in kept}
        allowed = self._bench.options.registration.alpha * state.part(fragment).spacing
        shots = self._bench.shots
        for index in weak.accepted:
            pose = weak.alignment.map_from_local.apply_to_pose(model.views[index].local_from_cam)
            before = self.memory.weak.get(index)
            self.memory.weak[index] = (fragment, pose.translation, kept)
            has_position = fragment in self._drift.tie_of and all(shots[i].gps for i in (index, *kept))
            offset = self._drift.position_offset(fragment, index, pose.translation, centres)
            if has_position and offset > WEAK_OFFSET:
                said = "lies off its position, and only two references hold it"
            elif (
                has_position
                or (
                    before is not None
                    and before[0] == fragment
                    and before[2] != kept
                    and float(np.linalg.norm(before[1] - pose.translation)) < allowed
                )
                or attitudes_agree(shots[index], pose, [(shots[i], state.map_from_cam(i)) for i in kept])
            ):
                confirmed.append(index)
                continue
            else:
                said = "held by two references only, and nothing else confirms where it is"
            refused.append(Rejection((index,), "references", said, outcome.numbers))
        if not confirmed:
            return refused[-1] if len(refused) == 1 else replace(outcome, reason=refused[-1].reason)
        self.memory.weakly_tied += len(confirmed)
        return replace(weak, accepted=tuple(confirmed), refused=tuple(refused))

    def _far_from_position(self, fragment: int, index: int, centre: Float, references: Mapping[int, Float]) -> float:
        """Positions ask for a second opinion: two reconstructions that agree on another place outvote them."""
        disagreement = self._drift.position_offset(fragment, index, centre, references)
        if disagreement > 1.0:
            before = self.memory.doubted.get(index)
            self.memory.doubted[index] = (fragment, centre)
            allowed = self._bench.options.registration.alpha * self._bench.state.part(fragment).spacing
            if before is not None and before[0] == fragment and np.linalg.norm(centre - before[1]) < allowed:
                return 0.0
        return disagreement

    def _without_orphans(self, outcome: Registration, subset: Subset, kept: set[int]) -> Registration | Rejection:
        """Refuse the new images whose own references were pruned: nothing kept speaks for where they are."""
        bench = self._bench
        if not bench.validates_queries or len(outcome.alignment.references) < bench.options.registration.min_references:
            return outcome  # those that too few references hold were confirmed otherwise
        least = bench.options.selection.min_shared_references
        lost = [i for i in orphans(subset, sorted(kept), bench.index, least) if i in outcome.accepted]
        refused = [Rejection((i,), "queries", "the references most like it were pruned", {}) for i in lost]
        accepted = tuple(i for i in outcome.accepted if i not in lost)
        if not accepted:
            return Rejection(subset.new, "queries", "the references most like the new images were pruned", {})
        return replace(outcome, accepted=accepted, refused=(*outcome.refused, *refused))
