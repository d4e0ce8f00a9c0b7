"""Joins: two fragments of the map become one when subsets that span them agree how they lie to each other."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from ..geometry.transforms import Rigid3, Sim3, rotation_angle_deg
from ..records import Rejection, Submap
from ..registration.overlap import check_overlap
from ..registration.register import Registration, register
from ..selection.bridge import bridging_subset, near_pairs
from .drift import Drift
from .workbench import Workbench, by_fragment

ATTEMPTS = 3  # bridging subsets at a time for two fragments
NEW_PAIRS = 4  # that look alike across two fragments make another attempt worth while
SPREAD = 2.0  # times what a reference may be shifted: so near to each other two opinions of a join must be
MAX_SCALE_STEP = 1.25
MAX_CONTRADICTIONS = 2  # more than confirmations, by subsets that span a join


@dataclass(frozen=True)
class Opinion:
    """What one subset says of two fragments, by a frame of each, so that it stays true while they are optimised."""

    frame: int  # of the one that would be moved
    other: int  # of the one that stays
    other_from_frame: Sim3  # from the frame in which the one stores its points to that of the other
    seen: frozenset[int]  # frames of both that it rests on


@dataclass
class Joined:
    """A join that was made, and what later subsets that span it said."""

    source: int
    into: int
    submaps: frozenset[int]  # of the source when it was joined
    bridges: frozenset[int]  # submaps that saw both sides
    confirmations: int = 0
    contradictions: int = 0


@dataclass
class JoinMemory:
    """What is kept of attempts to join, all of it a function of the subsets so far."""

    opinions: dict[tuple[int, int], list[Opinion]] = field(default_factory=dict)
    tried: set[tuple[int, int]] = field(default_factory=set)  # frames that were the middle of a bridging subset
    pairs_seen: dict[tuple[int, int], int] = field(default_factory=dict)
    joined: list[Joined] = field(default_factory=list)
    refused: int = 0
    undone: int = 0


class Joins:
    """Looks for fragments that overlap, joins them once two subsets or the positions confirm it, and undoes it."""

    def __init__(self, bench: Workbench, drift: Drift, progress: Callable[[str, int, int], None]) -> None:
        self._bench = bench
        self._drift = drift
        self._progress = progress
        self.memory = JoinMemory()

    def try_all(self, finishing: bool) -> bool:
        """Reconstruct frames of fragments that may overlap together; return whether any were joined.

        While images arrive, only where more pairs than at the last attempt look alike.
        """
        joined = False
        while self._try_one(finishing):
            joined = True
        return joined

    def _try_one(self, finishing: bool) -> bool:
        bench = self._bench
        fragments = bench.state.fragments()
        labels = list(fragments)
        for position, source in enumerate(labels):
            for into in labels[:position]:
                key = (source, into)
                pairs = near_pairs(
                    fragments[source],
                    fragments[into],
                    bench.index,
                    bench.frontier,
                    bench.options.selection.gps_candidates and finishing,
                )
                enough = len(pairs) >= self.memory.pairs_seen.get(key, 0) + NEW_PAIRS
                if not (enough or finishing):
                    continue
                self.memory.pairs_seen[key] = len(pairs)
                fresh = [p for p in pairs if not {(source, p[1]), (into, p[0])} & self.memory.tried]
                attempts = 0
                while fresh and attempts < ATTEMPTS:
                    attempts += 1
                    pair = fresh[0]
                    self.memory.tried |= {(source, pair[1]), (into, pair[0])}
                    self._progress("joining parts of the map", len(bench.state.frames), len(bench.shots))
                    if self._bridge(pair, fragments[source], fragments[into], effort=min(attempts - 1, 2)):
                        return True
                    fresh = [p for p in fresh if p[0] != pair[0] and p[1] != pair[1]]
        return False

    def _bridge(self, pair: tuple[int, int], source: list[int], into: list[int], effort: int) -> bool:
        bench = self._bench
        subset = bridging_subset(pair, source, into, bench.index, effort)
        subset, model = bench.infer(subset)
        if isinstance(model, Rejection):
            return False
        found = {}
        for label, references in by_fragment(bench.state, subset.references).items():
            outcome = register(
                model,
                replace(subset, references=references),
                bench.state.part(label),
                bench.threshold,
                bench.options.registration,
            )
            if isinstance(outcome, Rejection):
                return False
            found[label] = outcome
        if len(found) < 2:
            return False
        into_label, source_label = (bench.state.fragment_of(members[0]) for members in (into, source))
        one, other = found[into_label], found[source_label]
        verdict = self.examine(into_label, one, source_label, other)
        if verdict == "refused":
            return False
        number = bench.state.next_submap()
        submap = Submap(
            number, one.alignment.map_from_local, (), (*one.sightings, *other.sightings), fragment=into_label
        )
        bench.commit(model, submap, [])
        if verdict == "pending":
            return False
        self.make(source_label, into_label, one, other, number)
        return True

    def examine(self, into: int, one: Registration, source: int, other: Registration) -> str:
        """Return whether a join of two fragments that a subset spans is "refused", "pending" or "confirmed".

        It is confirmed by the positions of both, or by another subset with other frames that says the same.
        """
        bench = self._bench
        into_from_source = one.alignment.map_from_local @ other.alignment.map_from_local.inverse()
        parts = bench.state.part(source), bench.state.part(into)
        verdict = check_overlap(*parts, into_from_source, bench.index.similarities)
        offset = self._position_offset(source, into, into_from_source)
        if not verdict.passed or (offset is not None and offset > 1.0):
            self.memory.refused += 1
            return "refused"
        if offset is not None:
            return "confirmed"
        opinion = self._opinion(one, other, into_from_source)
        key = (min(source, into), max(source, into))
        before = self.memory.opinions.setdefault(key, [])
        agreeing = any(self._agree(known, source, into, into_from_source, opinion) for known in before)
        before.append(opinion)
        return "confirmed" if agreeing else "pending"

    def make(self, source: int, into: int, one: Registration, other: Registration, bridge: int) -> None:
        """Join two fragments by what one subset says of both; the pose graph balances it with all that ties them."""
        state = self._bench.state
        into_from_source = one.alignment.map_from_local @ other.alignment.map_from_local.inverse()
        fragments = state.fragments()
        if len(fragments[source]) > len(fragments[into]):
            source, into, into_from_source = into, source, into_from_source.inverse()
        submaps = frozenset(n for n, label in state.fragment_of_submap.items() if label == source)
        bridges = frozenset(
            seen.submap
            for seen in state.sightings
            if {state.fragment_of(seen.frame), state.fragment_of_submap[seen.submap]} == {source, into}
        )
        self.memory.joined.append(Joined(source, into, submaps, bridges | {bridge}))
        self.memory.opinions = {k: v for k, v in self.memory.opinions.items() if source not in k}
        state.join(source, into, into_from_source)
        self._drift.joined(source, into)
        self._bench.retry.reopen()

    def heard(self, fragment: int, references: Iterable[int], kept: Iterable[int]) -> None:
        """Take what a subset says of the joins that it spans, and undo a join that is contradicted.

        `references` are those that were reconstructed, `kept` those that agree with the map.
        """
        state, kept = self._bench.state, set(kept)
        here = [i for i in references if state.fragment_of(i) == fragment]
        for joined in [j for j in self.memory.joined if state.fragment_of_submap[min(j.submaps)] == fragment]:
            apart = self._side_of_source(joined)
            sides = {True: 0, False: 0}
            held = {True: 0, False: 0}
            for index in here:
                side = state.frames[index].submap in apart
                sides[side] += 1
                held[side] += index in kept
            if min(sides.values()) < 2:
                continue
            if min(held.values()) > 0:
                joined.confirmations += 1
            else:
                joined.contradictions += 1
            if joined.contradictions >= MAX_CONTRADICTIONS + joined.confirmations:
                self._undo(joined)

    def _side_of_source(self, joined: Joined) -> set[int]:
        """Return the submaps on the source's side of a join: later ones are where most of their sightings lie."""
        state = self._bench.state
        label, last = state.fragment_of_submap[min(joined.submaps)], max(joined.bridges)
        tied: dict[int, list[int]] = {}
        for seen in state.sightings:
            if seen.submap > last and state.fragment_of_submap[seen.submap] == label:
                tied.setdefault(seen.submap, []).append(state.frames[seen.frame].submap)
        apart = set(joined.submaps)
        for number in sorted(tied):
            if sum(other in apart for other in tied[number]) * 2 > len(tied[number]):
                apart.add(number)
        return apart

    def _undo(self, joined: Joined) -> None:
        """Part a fragment again, and let each part go on for itself."""
        state = self._bench.state
        label, apart = state.fragment_of_submap[min(joined.submaps)], self._side_of_source(joined)
        if any(n not in apart and n == label for n in state.fragment_of_submap):
            state.part_with(sorted(apart), joined.source)
            self._drift.forget(label)
            for fragment in (label, joined.source):
                self._drift.optimise(fragment)
        self.memory.joined.remove(joined)
        self.memory.undone += 1

    def _opinion(self, one: Registration, other: Registration, into_from_source: Sim3) -> Opinion:
        state = self._bench.state
        frame, target = other.alignment.references[0], one.alignment.references[0]
        relative = state.submap_pose_of(target).inverse() @ into_from_source @ state.submap_pose_of(frame)
        return Opinion(frame, target, relative, frozenset(one.alignment.references + other.alignment.references))

    def _agree(self, known: Opinion, source: int, into: int, into_from_source: Sim3, new: Opinion) -> bool:
        state = self._bench.state
        if known.seen == new.seen:
            return False  # the same frames say the same again
        told = state.submap_pose_of(known.other) @ known.other_from_frame @ state.submap_pose_of(known.frame).inverse()
        if state.fragment_of(known.frame) != source:
            told = told.inverse()
        allowed = SPREAD * self._bench.options.registration.alpha * state.part(into).spacing
        at = [_at(state.map_from_cam(i), into_from_source, told) for i in (new.frame,)]
        step = told.inverse() @ into_from_source
        return (
            max(at) <= allowed
            and rotation_angle_deg(step.rotation) <= self._bench.options.registration.max_rotation_deg
            and abs(np.log(step.scale)) <= np.log(MAX_SCALE_STEP)
        )

    def _position_offset(self, source: int, into: int, into_from_source: Sim3) -> float | None:
        """Return how far a join puts the source from where its positions say, over what is allowed; None if unknown."""
        state, bench = self._bench.state, self._bench
        if into not in self._drift.tie_of or not bench.options.registration.gps_check:
            return None
        here = {i: state.map_from_cam(i).translation for i in state.part(into).frames if bench.shots[i].gps}
        moved = [i for i in state.part(source).frames if bench.shots[i].gps]
        if not here or not moved:
            return None
        offsets = []
        for index in moved:
            centre = into_from_source.apply(state.map_from_cam(index).translation)
            nearest = sorted(here, key=lambda i: float(np.linalg.norm(here[i] - centre)))[:3]
            offsets.append(self._drift.position_offset(into, index, centre, {i: here[i] for i in nearest}))
        return float(np.median(offsets))


def _at(pose: Rigid3, one: Sim3, other: Sim3) -> float:
    return float(np.linalg.norm(one.apply(pose.translation) - other.apply(pose.translation)))
