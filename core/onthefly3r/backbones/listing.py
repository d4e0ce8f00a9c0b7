"""What backbones there are, what each needs here and what to do next: for `onthefly3r backbones` and `doctor`."""

from __future__ import annotations

from dataclasses import dataclass

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


def available_backbones() -> list[BackboneDescription]:
    """Describe every backbone that options can make; imports adapters but no torch and no upstream code."""
    return [_describe(name) for name in backbone_targets()]


def backbone_rows() -> list[tuple[str, ...]]:
    """Return a header and one row of text per backbone, for any table."""
    header = ("backbone", "installed", "weights", "GPU memory, 10 images", "licence", "next step")
    return [header, *(_row(item) for item in available_backbones())]


def print_backbones() -> None:
    """Print the table to standard output."""
    from rich.console import Console
    from rich.table import Table

    header, *rows = backbone_rows()
    table = Table(show_lines=True)
    for title in header:
        table.add_column(title, overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


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


def _row(item: BackboneDescription) -> tuple[str, ...]:
    weights = "none needed" if item.weights is None else item.weights or "not found"
    memory = "" if item.weights is None else "not published" if item.memory_gib is None else f"{item.memory_gib:g} GiB"
    return item.name, "yes" if item.installed else "no", weights, memory, item.licence, item.next_step
