"""The retrieval descriptor that the options name."""

from __future__ import annotations

from ..options import SelectionOptions
from .base import Describer
from .descriptors import LocalFeatures, VladDescriber
from .neural import EfficientNetDescriber, MegaLocDescriber, SupSceneDescriber


def create_describer(options: SelectionOptions, features: LocalFeatures, device: str) -> Describer:
    """Make the descriptor; `features` are for the one that needs local ones, networks run on `device`.

    Raises `MissingDependencyError` or `OptionError` with the remedy when its packages or weights are not here.
    """
    if options.descriptor == "efficientnet":
        return EfficientNetDescriber(device)
    if options.descriptor == "megaloc":
        return MegaLocDescriber(options.descriptor_weights, device)
    if options.descriptor == "supscene":
        return SupSceneDescriber(options.descriptor_weights, device)
    return VladDescriber(features)
