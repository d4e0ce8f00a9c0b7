"""How a result compares with a reference. Calling the package is calling `comparison.evaluate`: both have one name."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Compare a result with a reference; see `comparison.evaluate`."""
        from .comparison import evaluate

        return evaluate(*arguments, **named)


sys.modules[__name__].__class__ = _CallablePackage
