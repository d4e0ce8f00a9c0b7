"""On-the-Fly3R: georeferenced point clouds from drone photographs while they arrive."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .engine.loop import Engine
    from .options import Options
    from .run.result import Result
    from .run.session import reconstruct

__all__ = ["Engine", "Options", "Result", "__version__", "reconstruct"]


_HOMES = {"Engine": "engine.loop", "Options": "options", "Result": "run.result", "reconstruct": "run.session"}


def __getattr__(name: str) -> Any:
    """Import what is named on first use, so that importing the package loads nothing heavy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
