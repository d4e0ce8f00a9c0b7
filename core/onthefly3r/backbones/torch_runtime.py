"""One runtime for all neural backbones: device, precision, weights, GPU memory; the only place that drives torch.

A neural backbone is a subclass of `TorchBackbone` that says how photographs are prepared, how the network is
built and what its output means (see docs/backbones.md). Nothing here imports torch before it is used.
"""

from __future__ import annotations

import importlib.util
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..errors import MissingDependencyError, OptionError, require_memory
from ..geometry.camera import Camera
from ..networks.torch_tools import (
    autocast_dtype,
    is_out_of_memory,
    limit_gpu_memory,
    quiet_upstream,
    release_memory,
    select_device,
)
from ..networks.weights import FILE_NAMES, Weights, find_weights, load_strict, read_state
from ..options import BackboneOptions
from ..records import LocalModel, Rejection, Subset, WorkingImage
from .base import BackboneSpec
from .conventions import Canvas, NetworkImage, Prediction, compose, local_views, median_calibrations

log = logging.getLogger("onthefly3r.backbones")

MIN_REFERENCES = 3  # fewer do not tie a subset to the map


@dataclass(frozen=True)
class ModelCard:
    """What a user must know of a neural backbone before it runs."""

    name: str
    module: str  # the upstream package that must be importable
    install: str  # the command that installs it
    code_licence: str
    weights_licence: str
    weights_source: str  # a sentence: where the weights are
    confidence_threshold: float
    memory_gib: float | None = None  # GPU memory for a subset of 10 as published; None: not published
    weights_files: tuple[str, ...] = FILE_NAMES
    needs: tuple[str, ...] = ()  # further packages that the upstream code imports

    @property
    def licence(self) -> str:
        """Licences of code and weights in one line."""
        return f"code {self.code_licence}; weights {self.weights_licence}"

    def missing_packages(self) -> list[str]:
        """Return the packages among torch, the upstream code and its needs that are not installed."""
        return [name for name in ("torch", self.module, *self.needs) if importlib.util.find_spec(name) is None]

    def install_sentence(self, missing: Sequence[str]) -> str:
        """Return how to install what is missing."""
        steps = ["pip install torch safetensors"] if "torch" in missing else []
        return "; ".join(steps + ([self.install] if list(missing) != ["torch"] else []))


class TorchBackbone(ABC):
    """A frozen 3R network behind the backbone contract; subclasses only convert.

    Making one builds and loads the network: a run that lacks code, weights or memory ends before it began, with
    `MissingDependencyError` or `OptionError`.
    """

    card: ClassVar[ModelCard]
    spare_weights: ClassVar[tuple[str, ...]] = ()  # prefixes of weights that this use of the model leaves over

    def __init__(self, options: BackboneOptions) -> None:
        missing = self.card.missing_packages()
        if missing:
            raise MissingDependencyError(
                f"backbone {self.card.name}: {', '.join(missing)} missing; {self.card.install_sentence(missing)}"
            )
        weights = find_weights(self.card.name, options.weights, self.card.weights_source, self.card.weights_files)
        log.warning("%s: licence: %s", self.card.name, self.card.licence)
        self.spec = BackboneSpec(
            name=self.card.name,
            version=weights.label,
            licence=self.card.licence,
            confidence_threshold=self.card.confidence_threshold,
            has_tokens=True,
            weights=weights.fingerprint(),
        )
        self._device = select_device(options.device)
        limit_gpu_memory(self._device, options.max_gpu_memory_gib)
        if self._device.type == "cpu" and options.threads:
            import torch

            torch.set_num_threads(options.threads)
        self._network = self._load(weights)
        self._most_images: int | None = None  # what fitted into GPU memory after it had run out

    @abstractmethod
    def prepare(self, image: WorkingImage) -> NetworkImage:
        """Resize and crop one photograph as the network wants it."""

    @abstractmethod
    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Import the upstream code; return the network, still without weights, and the state under its own keys."""

    @abstractmethod
    def predict(self, network: Any, images: Any) -> Prediction:
        """Run the network on images (1, S, 3, H, W) in 0..1 on its device and convert what it answers."""

    def reconstruct(
        self, subset: Subset, images: Mapping[int, WorkingImage], calibrations: Mapping[str, Camera]
    ) -> LocalModel | Rejection:
        """Rebuild the subset; when GPU memory runs out, half of the new images, then of the references, are left out.

        References come best first; `MIN_REFERENCES` of them and one new image stay, or the subset is rejected.
        """
        started_s = time.perf_counter()
        least = 1 if subset.references else 2
        references, new = subset.references, subset.new
        if self._most_images is not None:
            new = new[: max(least, self._most_images - len(references))]
            references = references[: max(MIN_REFERENCES, self._most_images - len(new))]
        while True:
            members = references + new
            canvas = compose([self.prepare(images[index]) for index in members])
            prediction = self._run(canvas)
            if prediction is not None:
                break
            if len(new) > least:
                new = new[: max(least, len(new) // 2)]
            elif len(references) > MIN_REFERENCES:
                references = references[: max(MIN_REFERENCES, len(references) // 2)]
            else:
                return Rejection(
                    subset.new,
                    "backbone",
                    "out of memory: not even one new image fits; give --max-gpu-memory-gib more, or --device cpu",
                    {"images": float(len(members)), "height_px": canvas.size[0], "width_px": canvas.size[1]},
                )
            self._most_images = len(references) + len(new)
            log.warning("%s: GPU memory ran out; going on with %d images", self.card.name, self._most_images)
        views = local_views(members, canvas, prediction)
        return LocalModel(
            views,
            prediction.metric,
            median_calibrations(views, images, calibrations),
            notes={"inference_s": time.perf_counter() - started_s},
            left_out=subset.new[len(new) :],
        )

    def _load(self, weights: Weights) -> Any:
        try:
            with quiet_upstream():
                network, state = self.build(read_state(weights.path), weights.config)
        except ImportError as error:
            require_memory(error)
            raise MissingDependencyError(
                f"backbone {self.card.name}: its upstream code cannot be imported ({error}); install what it names"
            ) from error
        load_strict(network, state, str(weights.path), self.spare_weights)
        network = network.eval().requires_grad_(False)
        try:
            return network.to(self._device)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            raise OptionError(
                f"backbone {self.card.name}: the network alone does not fit into the memory of {self._device}; "
                "give --max-gpu-memory-gib more, or --device cpu"
            ) from error

    def _run(self, canvas: Canvas) -> Prediction | None:
        import torch

        dtype = autocast_dtype(self._device)
        try:
            images = torch.from_numpy(np.ascontiguousarray(np.moveaxis(canvas.rgb, 3, 1)))[None].to(self._device)
            autocast = torch.autocast(self._device.type, dtype, enabled=dtype is not None)
            with torch.inference_mode(), autocast, quiet_upstream():
                return self.predict(self._network, images)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
        release_memory(self._device)
        return None
