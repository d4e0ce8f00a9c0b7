"""On-the-Fly3R: georeferenced point clouds from drone photographs while they arrive."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .commands.check import check_photographs
    from .engine.loop import Engine
    from .errors import (
        BusyError,
        Cancelled,
        GeoreferenceError,
        InputError,
        MissingDependencyError,
        OnTheFly3RError,
        OptionError,
        PhotographError,
        ReconstructionError,
        ReferenceFormatError,
        StorageError,
    )
    from .evaluate.comparison import evaluate
    from .options import Options
    from .run.export import export, georeference
    from .run.result import Result
    from .run.session import Session, reconstruct

__all__ = [
    "BusyError",
    "Cancelled",
    "Engine",
    "GeoreferenceError",
    "InputError",
    "MissingDependencyError",
    "OnTheFly3RError",
    "OptionError",
    "Options",
    "PhotographError",
    "ReconstructionError",
    "ReferenceFormatError",
    "Result",
    "Session",
    "StorageError",
    "__version__",
    "check_photographs",
    "evaluate",
    "export",
    "georeference",
    "reconstruct",
]

_HOMES = {
    "Engine": "engine.loop",
    "Options": "options",
    "Result": "run.result",
    "Session": "run.session",
    "check_photographs": "commands.check",
    "export": "run.export",
    "georeference": "run.export",
    "reconstruct": "run.session",
}


def __getattr__(name: str) -> Any:
    """Import what is named on first use, so that importing the package loads nothing heavy."""
    if name == "evaluate":  # the package is the function
        return importlib.import_module(".evaluate", __name__)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES.get(name, 'errors')}", __name__), name)
