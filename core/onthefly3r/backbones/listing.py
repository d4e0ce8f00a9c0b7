"""What backbones there are, what each needs here and what to do next: for `onthefly3r backbones` and `doctor`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from ..errors import OnTheFly3RError
from ..networks.weights import local_weights
from .registry import BUILT_IN, backbone_targets, load_backbone
from .torch_runtime import ModelCard

OWN_LICENCE = "GPL-2.0-or-later"


@dataclass(frozen=True)
class BackboneDescription:
    """One backbone as a user sees it; `weights` is None for a backbone without any."""

    name: str
    installed: bool
    weights: str | None  # path, or "" when none were found
    licence: str
    memory_gib: float | None  # GPU memory for a subset of 10 images, as published
    next_step: str

    @property
    def ready(self) -> bool:
        """Whether a run with this backbone can start now."""
        return self.installed and self.weights != ""

    @property
    def state(self) -> str:
        """Whether it can run, in a word or two."""
        if not self.installed:
            return "not installed"
        return "ready" if self.ready else "weights not found"


def available_backbones() -> list[BackboneDescription]:
    """Describe every backbone that options can make; imports adapters but no torch and no upstream code."""
    return [_describe(name) for name in backbone_targets()]


def backbones_text() -> str:
    """Return a paragraph for each backbone; lines are not broken, so that addresses stay whole."""
    return "\n\n".join(_paragraph(item) for item in available_backbones())


def backbones_json() -> str:
    """Return all of them as one JSON object."""
    rows = [{**asdict(item), "ready": item.ready} for item in available_backbones()]
    return json.dumps({"backbones": rows}, ensure_ascii=False)


def _describe(name: str) -> BackboneDescription:
    run = f"onthefly3r run PHOTOS OUT --backbone {name}"
    try:
        card = getattr(load_backbone(name), "card", None)
    except OnTheFly3RError as error:
        return BackboneDescription(name, False, None, "", None, str(error))
    if not isinstance(card, ModelCard):
        licence = OWN_LICENCE if name in BUILT_IN else "as its package says"
        return BackboneDescription(name, True, None, licence, None, run)
    missing, path = card.missing_packages(), local_weights(name)
    if missing:
        next_step = f"{', '.join(missing)} missing: {card.install_sentence(missing)}"
    elif path is None:
        next_step = f"{card.weights_source} Then: {run} --weights PATH"
    else:
        next_step = run
    weights = "" if path is None else str(path)
    return BackboneDescription(name, not missing, weights, card.licence, card.memory_gib, next_step)


def _paragraph(item: BackboneDescription) -> str:
    lines = [f"{item.name}: {item.state}"]
    if item.weights:
        lines.append(f"  weights     {item.weights}")
    if item.licence:
        lines.append(f"  licence     {item.licence}")
    if item.weights is not None:
        memory = "not published" if item.memory_gib is None else f"{item.memory_gib:g} GiB"
        lines.append(f"  GPU memory  {memory} (subset of 10 photographs)")
    return "\n".join([*lines, f"  {'run' if item.ready else 'next'}".ljust(14) + item.next_step])
