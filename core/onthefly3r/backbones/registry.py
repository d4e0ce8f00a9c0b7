"""Backbones by name: our own and those that other packages offer by the entry-point group `onthefly3r.backbones`."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from importlib import metadata

from ..errors import MissingDependencyError, OptionError, require_memory
from ..features.extraction import FeatureStore
from ..options import BackboneOptions
from .base import Backbone

GROUP = "onthefly3r.backbones"
BUILT_IN = {
    "classical": "onthefly3r.backbones.classical:ClassicalBackbone",
    "da3": "onthefly3r.backbones.da3:DepthAnything3",
    "pi3": "onthefly3r.backbones.pi3:Pi3",
    "pi3x": "onthefly3r.backbones.pi3:Pi3X",
    "vggt": "onthefly3r.backbones.vggt:Vggt",
    "vggt-omega": "onthefly3r.backbones.vggt:VggtOmega",
    "mapanything": "onthefly3r.backbones.mapanything:MapAnything",
}
NEED_TRUTH = {"oracle": "onthefly3r.simulate.oracle:OracleBackbone"}  # made from a simulated survey, not from options


def backbone_targets() -> dict[str, str]:
    """Return `module:attribute` of what options can make, by name, without importing it; our names stay ours."""
    offered = {point.name: point.value for point in metadata.entry_points(group=GROUP)}
    return {**BUILT_IN, **{name: target for name, target in offered.items() if name not in BUILT_IN}}


def load_backbone(name: str) -> Callable[..., Backbone]:
    """Import the class or function that makes backbone `name`, from `BackboneOptions` unless it needs the truth.

    Raises `OptionError` for an unknown name and `MissingDependencyError` when its module cannot be imported.
    """
    targets = {**backbone_targets(), **NEED_TRUTH}
    if name not in targets:
        near = difflib.get_close_matches(name, targets, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise OptionError(f"backbone: {name!r} is not one of {', '.join(sorted(targets))}{hint}")
    module, _, attribute = targets[name].partition(":")
    try:
        factory: Callable[..., Backbone] = getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        require_memory(error)
        raise MissingDependencyError(f"backbone {name}: cannot be imported ({error}); install what it names") from error
    except AttributeError as error:
        raise MissingDependencyError(f"backbone {name}: {module} has no {attribute}; update that package") from error
    return factory


def create_backbone(options: BackboneOptions, features: FeatureStore | None = None) -> Backbone:
    """Make the backbone that the options name; the classical one shares the run's local features with retrieval.

    Raises `InputError` with the remedy when it cannot run here.
    """
    if options.backbone in NEED_TRUTH:
        raise OptionError(
            f"backbone {options.backbone}: answers from the truth of a simulated survey, which photographs do not "
            f"have; choose one of {', '.join(backbone_targets())}"
        )
    make = load_backbone(options.backbone)
    return make(options, features) if options.backbone == "classical" else make(options)
