"""What the report tells of the dense cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from .layers import LayerSpread

Checkpoint = Callable[[str, int, int], None]  # (stage, photographs done, in all); may raise `Cancelled`


@dataclass
class DenseFigures:
    """Filled while the points are made; complete once the last of them was taken."""

    quality: str
    metric: bool = True  # whether lengths are in metres
    photographs: int = 0  # that gave points
    unreadable: list[str] = field(default_factory=list)  # names of photographs that could not be opened again
    before_alignment: float = float("nan")  # how far overlapping maps lie apart, relative to depth (nmad),
    after_alignment: float = float("nan")
    single: LayerSpread | None = None  # of the photographs' own aligned maps,
    averaged: LayerSpread | None = None  # and of their averages

    def warnings(self) -> list[str]:
        """Return what the user should know: photographs that took no part."""
        if not self.unreadable:
            return []
        named = ", ".join(self.unreadable[:3]) + (" and others" if len(self.unreadable) > 3 else "")
        count = len(self.unreadable)
        return [f"{count} photographs could not be read again ({named}): their part of the cloud is a preview"]

    def told(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        layers = {name: asdict(found) for name in ("single", "averaged") if (found := getattr(self, name)) is not None}
        return {
            "quality": self.quality,
            "photographs": self.photographs,
            "unreadable": list(self.unreadable),
            "misfit_before_alignment": self.before_alignment,
            "misfit_after_alignment": self.after_alignment,
            "layers": layers,
        }
