"""The contract of a retrieval descriptor, and the descriptor that the options name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from ..geometry.arrays import Float
from ..options import SelectionOptions
from ..records import Features, WorkingImage


class Describer(Protocol):
    """Turns images into L2-normalised vectors whose dot product is a similarity (Eq. 4)."""

    def fit(self, images: Mapping[int, WorkingImage]) -> None:
        """Learn what must be learnt (a codebook) from the first images, by shot index; called once."""
        ...

    def describe(self, index: int, image: WorkingImage) -> Float:
        """Return the descriptor (D,) float32 of one image."""
        ...


@runtime_checkable
class Learns(Protocol):
    """A descriptor that `fit` teaches something, which a run that goes on takes from the disk."""

    def learnt(self) -> Mapping[str, Float]:
        """Return what `fit` learnt, by name."""
        ...

    def recall(self, learnt: Mapping[str, Float]) -> None:
        """Take what `learnt` returned, instead of `fit`; raises `KeyError` when something is missing."""
        ...


class LocalFeatures(Protocol):
    """Where the local features of images come from, by shot index."""

    def extract(self, images: Mapping[int, WorkingImage]) -> None:
        """Extract those of several images at once and keep them."""
        ...

    def features_of(self, index: int, image: WorkingImage) -> Features:
        """Return those of one image, extracted on first demand."""
        ...


def create_describer(options: SelectionOptions, features: LocalFeatures, device: str) -> Describer:
    """Make the descriptor; `features` are for the one that needs local ones, networks run on `device`.

    Raises `MissingDependencyError` or `OptionError` with the remedy when its packages or weights are not here.
    """
    from .descriptors import VladDescriber
    from .neural import EfficientNetDescriber, MegaLocDescriber, SupSceneDescriber

    if options.descriptor == "efficientnet":
        return EfficientNetDescriber(device)
    if options.descriptor == "megaloc":
        return MegaLocDescriber(options.descriptor_weights, device)
    if options.descriptor == "supscene":
        return SupSceneDescriber(options.descriptor_weights, device)
    return VladDescriber(features)
