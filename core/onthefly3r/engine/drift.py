"""Drift: when it shows in a fragment of the map, and how the pose graph, positions and refinement remove it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..earth.blockadjust import adjust_block
from ..geometry.arrays import Float
from ..graph.gpsprior import GpsTie, gps_disagreement, pose_priors, tie_to_positions
from ..graph.posegraph import default_solver, optimise_frames, optimise_submaps
from ..graph.solver import PoseGraphSolver
from .workbench import Workbench

# Drift is removed when it shows, or when the map has grown by this share, but not before it has so many new submaps:
# where little is new, chance moves a map as much as what is learnt, and may move it away from the truth.
OPTIMISE_EVERY = 20
OPTIMISE_GROWTH = 1.0
DRIFT_SHOWS = 2.2  # times the usual residual: references that far apart were placed along different ways


class Drift:
    """Optimises each fragment for itself, and remembers how its alignments went and where it is on Earth."""

    def __init__(self, bench: Workbench) -> None:
        self._bench = bench
        self._solver: PoseGraphSolver | None = None
        self.residuals_of: dict[int, list[float]] = {}  # of all alignments, map units
        self.optimised_submaps: dict[int, int] = {}
        self.shows: set[int] = set()
        self.tie_of: dict[int, GpsTie] = {}
        self.refinement: Mapping[str, Any] = {}

    def note(self, fragment: int, residual: float) -> None:
        """Note how well a subset fitted a fragment."""
        residuals = self.residuals_of.setdefault(fragment, [])
        residuals.append(residual)
        if residual > DRIFT_SHOWS * float(np.median(residuals)):
            self.shows.add(fragment)

    def is_worth_removing(self, fragment: int) -> bool:
        """Return whether there is more to gain from a pass of the pose graph than chance can spoil."""
        before = self.optimised_submaps.get(fragment, 0)
        grown = len(self._bench.state.part(fragment).map_from_submap) - before
        return grown >= OPTIMISE_EVERY and (fragment in self.shows or grown >= OPTIMISE_GROWTH * before)

    def optimise(self, fragment: int) -> None:
        """Tie a fragment to the positions as it is now, and remove its drift."""
        bench = self._bench
        self.shows.discard(fragment)
        graph = bench.options.pose_graph
        part = bench.state.part(fragment)
        with bench.stopwatch.stage("pose graph"), bench.optional("the pose graph"):
            self.optimised_submaps[fragment] = len(part.map_from_submap)
            if graph.gps_priors or bench.options.registration.gps_check:
                tie = tie_to_positions(part, bench.shots, bench.options.georeference)
                self.tie_of.pop(fragment, None)
                if tie is not None:
                    self.tie_of[fragment] = tie
            if graph.pose_graph == "none" or len(part.map_from_submap) < 2:
                return
            self._solver = self._solver or default_solver()
            if graph.pose_graph == "se3":
                optimise_frames(part, self._solver)
                return
            known = self.tie_of.get(fragment) if graph.gps_priors else None
            optimise_submaps(part, self._solver, pose_priors(part, known, bench.shots) if known else [])

    def joined(self, source: int, into: int) -> None:
        """Forget a fragment that is part of another now, and optimise that one."""
        self.forget(source)
        self.optimise(into)

    def forget(self, fragment: int) -> None:
        """Forget what was known of a fragment that is no more as it was."""
        for known in (self.residuals_of, self.optimised_submaps, self.tie_of):
            known.pop(fragment, None)
        self.shows.discard(fragment)

    def position_offset(self, fragment: int, index: int, centre: Float, references: Mapping[int, Float]) -> float:
        """Return how far an image lands from its position over what is allowed; 0 where nothing can be said."""
        tie = self.tie_of.get(fragment)
        return gps_disagreement(index, centre, references, self._bench.shots, tie) if tie else 0.0

    def refine(self) -> None:
        """Adjust all cameras of each fragment together; the largest one says what the cameras are like."""
        bench = self._bench
        with bench.stopwatch.stage("refinement"), bench.optional("the refinement"):
            for rank, fragment in enumerate(bench.state.fragments()):
                part = bench.state.part(fragment)
                own = (
                    (number, observed)
                    for number, observed in bench.store.stream_observations()
                    if number in part.map_from_submap
                )
                adjusted = adjust_block(part, own, bench.shots, bench.options)
                if adjusted is None:
                    continue
                found = adjusted.refinement
                part.move_refined(found.map_from_submap, found.calibrations if rank == 0 else {})
                if rank == 0:
                    self.refinement = found.notes
                    bench.warnings += adjusted.warnings
                    if adjusted.tie is not None:
                        bench.state.set_tie(adjusted.tie)
