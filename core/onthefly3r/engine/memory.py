"""What the engine knows beside the map, as one record: with the journal it says how a run goes on.

After each step, what changed of it becomes a line of the journal. Whatever decides the next step is in it: a new member
of the engine's parts that does must be named here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from ..earth.positions import Positions
from ..errors import InputError
from ..files.tagged_json import from_tagged, to_tagged
from ..geometry.geodesy import EnuFrame
from ..geometry.transforms import Sim3
from ..graph.gpsprior import GpsTie
from ..map.store import Store
from ..records import Rejection
from .joining import Joined, Opinion

if TYPE_CHECKING:
    from .loop import Engine

CLASSES = (Sim3, GpsTie, Positions, EnuFrame, Opinion, Joined, Rejection)


class StepJournal:
    """Writes the engine's memory into the journal, each time what changed since the last line."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._noted: dict[str, str] = {}

    def note(self, engine: Engine) -> None:
        """End a step: what the journal holds up to here is what a run goes on from."""
        now = {key: json.dumps(to_tagged(value)) for key, value in memory_of(engine).items()}
        changed = {key: json.loads(text) for key, text in now.items() if self._noted.get(key) != text}
        gone = sorted(self._noted.keys() - now.keys())
        self._store.end_step({"set": changed, "gone": gone})
        self._noted = now

    def recall(self, engine: Engine, steps: list[Any]) -> None:
        """Give the engine what the steps of a journal say; raises `InputError` when they are damaged."""
        told: dict[str, Any] = {}
        try:
            for step in steps:
                told.update(step["set"])
                for key in step["gone"]:
                    del told[key]
            _recall(engine, {key: from_tagged(value, CLASSES) for key, value in told.items()})
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"the journal's steps are damaged ({error!r})") from error
        self._noted = {key: json.dumps(value) for key, value in told.items()}


def memory_of(engine: Engine) -> dict[str, Any]:
    """Return what decides the next step, beside the map, by name."""
    drift = engine.drift
    return {
        "phase": engine.phase,
        "read": engine.read,
        "described": engine.described,
        "fitted": engine.fitted,
        "pending": engine.pending,
        "waiting": engine.waiting,
        "backbone_calls": engine.backbone_calls,
        "warnings": engine.warnings,
        "retry": engine.retry.memory,
        "seeds": (engine.seeds.refused, engine.seeds.refused_fragments),
        "drift": (drift.optimised_submaps, drift.shows, dict(drift.refinement)),
        **{f"residuals/{fragment}": known for fragment, known in drift.residuals_of.items()},
        **{f"tie/{fragment}": tie for fragment, tie in drift.tie_of.items()},
        **{f"joins/{f.name}": getattr(engine.joins.memory, f.name) for f in fields(engine.joins.memory)},
        **{f"steps/{f.name}": getattr(engine.steps.memory, f.name) for f in fields(engine.steps.memory)},
        **{f"rejection/{index}": rejection for index, rejection in engine.rejections.items()},
    }


def _recall(engine: Engine, known: Mapping[str, Any]) -> None:
    """Inverse of `memory_of`, but for the images: who was described must be described again."""

    def numbered(kind: str) -> dict[int, Any]:
        found = ((key.split("/"), value) for key, value in known.items() if key.startswith(f"{kind}/"))
        return {int(number): value for (_, number), value in found}

    drift = engine.drift
    for name in ("phase", "read", "described", "fitted", "pending", "waiting", "backbone_calls", "warnings"):
        setattr(engine, name, known[name])
    engine.retry.memory = known["retry"]
    engine.seeds.refused, engine.seeds.refused_fragments = known["seeds"]
    drift.optimised_submaps, drift.shows, drift.refinement = known["drift"]
    drift.residuals_of, drift.tie_of = numbered("residuals"), numbered("tie")
    for kind, memory in (("joins", engine.joins.memory), ("steps", engine.steps.memory)):
        for item in fields(memory):
            setattr(memory, item.name, known[f"{kind}/{item.name}"])
    engine.rejections.update(numbered("rejection"))
