"""The retrieval descriptor that the options name."""

from __future__ import annotations

from collections.abc import Callable

from ..options import SelectionOptions
from ..records import Features, WorkingImage
from .base import Describer
from .descriptors import VladDescriber
from .neural import EfficientNetDescriber, MegaLocDescriber, SupSceneDescriber


def create_describer(
    options: SelectionOptions, features_of: Callable[[int, WorkingImage], Features], device: str
) -> Describer:
    """Make the descriptor; `features_of` gives local features to the one that needs them, networks run on `device`.

    Raises `MissingDependencyError` or `OptionError` with the remedy when its packages or weights are not here.
    """
    if options.descriptor == "efficientnet":
        return EfficientNetDescriber(device)
    if options.descriptor == "megaloc":
        return MegaLocDescriber(options.descriptor_weights, device)
    if options.descriptor == "supscene":
        return SupSceneDescriber(options.descriptor_weights, device)
    return VladDescriber(features_of)
