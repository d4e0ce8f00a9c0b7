"""The contract of a local reconstructor (Phi of Eq. 1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

from ..geometry.camera import Camera
from ..networks.weights import Fingerprint
from ..records import LocalModel, Rejection, Subset, WorkingImage


@dataclass(frozen=True)
class BackboneSpec:
    """What the engine must know of a backbone before it calls it."""

    name: str
    version: str
    licence: str
    confidence_threshold: float  # points below it are not used: confidences differ between models
    has_tokens: bool = False
    weights: Fingerprint | None = None  # of a neural backbone

    def facts(self) -> dict[str, Any]:
        """Return what the report says of the backbone, JSON values."""
        weights = None if self.weights is None else asdict(self.weights)
        return {"name": self.name, "version": self.version, "licence": self.licence, "weights": weights}


@runtime_checkable
class ExtractsFeatures(Protocol):
    """A backbone or descriptor that works on local features, which several photographs at once give faster."""

    def extract_features(self, images: Mapping[int, WorkingImage]) -> None:
        """Extract and keep the features of new images, by shot index."""
        ...


@runtime_checkable
class Interruptible(Protocol):
    """A backbone whose single calls may take longer than a user who cancels should wait."""

    def interrupt_with(self, checkpoint: Callable[[], None]) -> None:
        """Call `checkpoint` every now and then while it works, at best each second; what it raises ends the work."""
        ...


class Backbone(Protocol):
    """A frozen model that rebuilds a small subset in a frame of its own.

    It sees only its subset: no map poses and no positions. `calibrations` holds the intrinsics per camera
    key (at photograph size) that earlier subsets established; a camera key that is missing there is new, and
    a backbone that estimates intrinsics returns them in `LocalModel.calibrations`.
    """

    @property
    def spec(self) -> BackboneSpec:
        """Name, licence and thresholds."""
        ...

    def reconstruct(
        self, subset: Subset, images: Mapping[int, WorkingImage], calibrations: Mapping[str, Camera]
    ) -> LocalModel | Rejection:
        """Rebuild the subset; images that could not be placed are missing from the model's views."""
        ...
