"""One place to import pycolmap: what must come before it, and how loud it may be."""

from __future__ import annotations

import zlib  # noqa: F401 - must be loaded before pycolmap, else PNG and deflate writers of this process abort
from functools import lru_cache
from typing import Any


@lru_cache(maxsize=1)
def load_pycolmap() -> Any:
    """Return the pycolmap module with its chatter silenced: only errors reach standard error."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR.value)
    return pycolmap
