"""Seeds: joint reconstructions of images that hang together, each the beginning of a fragment of the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ..geometry.transforms import Sim3
from ..records import LocalModel, Rejection, Submap, Subset
from ..registration.references import scene_spacing
from ..registration.register import check_seed, seed_edges
from ..selection.seed import choose_first_seed, choose_seed, hanging_together
from .drift import Drift
from .workbench import Workbench

SEED_ATTEMPTS = 5
MIN_SEED_SHARE = 0.5
# A further fragment begins small, to cost little where it comes to nothing; it grows by the ordinary steps.
FRAGMENT_SEED = 12
LEAST_FRAGMENT = 5  # images that must hang together where no more may come,
LEAST_FRAGMENT_SO_FAR = 10  # and where more may
FRAGMENT_ATTEMPTS = 3  # refused seeds of further fragments, for each fragment that there is


class Seeds:
    """Begins fragments; remembers the starts that came to nothing."""

    def __init__(self, bench: Workbench, drift: Drift, progress: Callable[[str, int, int], None]) -> None:
        self._bench = bench
        self._drift = drift
        self._progress = progress
        self.refused: set[int] = set()
        self.refused_fragments: set[int] = set()

    def begin_map(self, finishing: bool) -> bool:
        """Find a seed that hangs together (Eq. 1, Eq. 3); return whether there is a map now."""
        bench = self._bench
        size = bench.options.selection.seed_size
        while bench.waiting and (finishing or len(bench.waiting) >= size):
            if not finishing and len(self.refused) >= SEED_ATTEMPTS * len(bench.waiting) // size:
                return False  # more images make more attempts worth while
            # Attempts after the first few are smaller: a small group may hang together where a large one does not.
            wanted = size if len(self.refused) < SEED_ATTEMPTS else max(5, size // 3)
            refused = frozenset(self.refused)
            in_order = bench.options.selection.in_order
            choose = choose_first_seed if in_order else choose_seed
            seed = choose(bench.waiting, bench.index.similarities, wanted, refused, bench.near_copies)
            if in_order and len(seed) < wanted and not finishing:
                return False  # images that hang together with these may still arrive
            if self.refused and bench.options.registration.fragments:  # the photographs may be of several places
                seed = hanging_together(seed, bench.waiting, bench.index.similarities)
            if len(seed) < 3 or len(self.refused) > 3 * SEED_ATTEMPTS:
                if finishing:
                    numbers = {"attempts": float(len(self.refused))}
                    bench.reject(Rejection(tuple(bench.waiting), "seed", "no group of images hangs together", numbers))
                    bench.waiting = []
                return False
            self._progress("starting the map", 0, len(bench.shots))
            if self._commit(seed):
                return True
            self.refused.add(seed[0])
        return False

    def begin_fragment(self, candidates: Sequence[int], finishing: bool) -> bool:
        """Begin a fragment of images that hang together better among themselves than with the map, if there are any.

        An image hangs together with others when enough of its near neighbours, among all images, are of them.
        """
        bench = self._bench
        if not bench.options.registration.fragments:
            return False
        least = LEAST_FRAGMENT if finishing else LEAST_FRAGMENT_SO_FAR
        allowed = FRAGMENT_ATTEMPTS * len(bench.state.fragments())
        while len(candidates) >= least and len(self.refused_fragments) < allowed:
            group = bench.frontier.hanging_together(candidates, bench.index)
            if len(group) < least:
                return False
            tried = frozenset(self.refused_fragments)
            seed = choose_seed(group, bench.index.similarities, FRAGMENT_SEED, tried, bench.near_copies)
            seed = tuple(bench.frontier.hanging_together(seed, bench.index, first=seed[:1]))
            if len(seed) < min(least, FRAGMENT_SEED) or bench.frontier.prefers(seed, bench.state.frames, bench.index):
                return False
            self._progress("starting another part of the map", len(bench.state.frames), len(bench.shots))
            if self._commit(seed):
                return True
            self.refused_fragments.add(seed[0])
            candidates = [i for i in candidates if i != seed[0]]
        return False

    def _commit(self, seed: tuple[int, ...]) -> bool:
        bench = self._bench
        subset, model = bench.infer(Subset(references=(), new=seed))
        if isinstance(model, Rejection):
            return False
        refused = check_seed(model.views, bench.threshold) if bench.validates_queries else {}
        good = [i for i in subset.new if i in model.views and i not in refused]
        spacing = scene_spacing({i: model.views[i] for i in good}, bench.threshold)
        if len(good) < self._least(subset, model) or not spacing > 0.0:
            return False
        number = bench.state.next_submap()
        bench.state.set_spacing(spacing, number)
        is_papers_graph = bench.options.pose_graph.pose_graph == "se3"
        edges = seed_edges(model.views, good, bench.threshold) if is_papers_graph else ()
        bench.commit(model, Submap(number, Sim3(), (), (), edges, fragment=number), good)
        self._drift.optimise(number)
        return True

    def _least(self, subset: Subset, model: LocalModel) -> float:
        """Return how many images of a seed must be sound.

        Half of them; but a joint reconstruction may fall apart, and then the part that holds is a seed, if it is one
        for itself and most of it is sound: the others go to other subsets.
        """
        of_all = max(3.0, MIN_SEED_SHARE * (len(subset.new) - len(model.left_out)))
        if not self._bench.options.registration.fragments:
            return of_all
        return min(of_all, max(LEAST_FRAGMENT_SO_FAR, MIN_SEED_SHARE * len(model.views)))
