"""On-the-Fly3R: georeferenced point clouds from drone photographs while they arrive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .engine import Engine, Result, reconstruct
    from .options import Options

__all__ = ["Engine", "Options", "Result", "__version__", "reconstruct"]


def __getattr__(name: str) -> Any:
    """Import the engine on first use, so that importing the package loads nothing heavy."""
    if name in ("Engine", "Result", "reconstruct"):
        from . import engine

        return getattr(engine, name)
    if name == "Options":
        from .options import Options

        return Options
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
