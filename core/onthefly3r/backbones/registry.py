"""Backbones by name: our own and those that other packages offer by the entry-point group `onthefly3r.backbones`."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from importlib import metadata

from ..errors import MissingDependencyError, OptionError
from ..options import BackboneOptions
from .base import Backbone

GROUP = "onthefly3r.backbones"
BUILT_IN = {
    "classical": "onthefly3r.backbones.classical:ClassicalBackbone",
    "oracle": "onthefly3r.simulate.oracle:OracleBackbone",  # answers from the truth of a simulated survey
    "da3": "onthefly3r.backbones.da3:DepthAnything3",
    "pi3": "onthefly3r.backbones.pi3:Pi3",
    "pi3x": "onthefly3r.backbones.pi3:Pi3X",
    "vggt": "onthefly3r.backbones.vggt:Vggt",
    "vggt-omega": "onthefly3r.backbones.vggt:VggtOmega",
    "mapanything": "onthefly3r.backbones.mapanything:MapAnything",
}

Factory = Callable[[BackboneOptions], Backbone]


def backbone_targets() -> dict[str, str]:
    """Return `module:attribute` by name without importing anything; our own names cannot be taken over."""
    offered = {point.name: point.value for point in metadata.entry_points(group=GROUP)}
    return {**offered, **BUILT_IN}


def load_backbone(name: str) -> Factory:
    """Import the class or function that makes backbone `name` from its options.

    Raises `OptionError` for an unknown name and `MissingDependencyError` when its module cannot be imported.
    """
    targets = backbone_targets()
    if name not in targets:
        near = difflib.get_close_matches(name, targets, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise OptionError(f"backbone: {name!r} is not one of {', '.join(sorted(targets))}{hint}")
    module, _, attribute = targets[name].partition(":")
    try:
        factory: Factory = getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        raise MissingDependencyError(f"backbone {name}: cannot be imported ({error}); install what it names") from error
    except AttributeError as error:
        raise MissingDependencyError(f"backbone {name}: {module} has no {attribute}; update that package") from error
    return factory


def create_backbone(options: BackboneOptions) -> Backbone:
    """Make the backbone that the options name; raises `InputError` with the remedy when it cannot run here."""
    return load_backbone(options.backbone)(options)
