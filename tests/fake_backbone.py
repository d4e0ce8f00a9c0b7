"""A neural backbone as another package would offer it: its network answers from the truth of a simulated survey.

What it answers depends on its weights, so that one with random weights, or none, cannot pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from onthefly3r.backbones.conventions import (
    NetworkImage,
    Prediction,
    confidence_from_one_plus_exp,
    network_image,
    rigid_inverse,
    unproject,
)
from onthefly3r.backbones.torch_runtime import ModelCard, TorchBackbone
from onthefly3r.geometry.transforms import Sim3, rotation_exp
from onthefly3r.networks.torch_tools import to_numpy
from onthefly3r.records import WorkingImage
from onthefly3r.simulate.flight import Survey

WIDTH, HEIGHT = 96, 72
STEP = 10  # grey levels from one photograph's number to the next
GAIN = 0.0125  # what the trained network multiplies metres with


class TrueNetwork(torch.nn.Module):
    """Depth, cameras, confidence and tokens of photographs whose numbers are painted on them."""

    def __init__(self, survey: Survey) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.rand(1))
        self.survey = survey
        self.calls: list[tuple[int, ...]] = []

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        numbers = [round(float(v) * 255.0 / STEP) for v in images[0, :, 0].mean(dim=(1, 2))]
        self.calls.append(tuple(numbers))
        rng = np.random.default_rng(len(self.calls))
        gain = float(self.gain)
        local_from_enu = Sim3(gain, rotation_exp(rng.uniform(-2.0, 2.0, 3)), rng.normal(0.0, 3.0, 3))
        context = rng.standard_normal(16)
        answers: dict[str, list[np.ndarray]] = {"cam_from_local": [], "depth": [], "focal": [], "confidence": []}
        tokens = []
        for number in numbers:
            view = self.survey.views[number]
            camera = view.camera.resized(WIDTH, HEIGHT)
            hits = self.survey.scene.view(camera, view.enu_from_cam, camera.pixel_centres())
            pose = local_from_enu.apply_to_pose(view.enu_from_cam)
            answers["cam_from_local"].append(pose.inverse().matrix())
            answers["depth"].append(gain * hits.distances.reshape(HEIGHT, WIDTH))
            answers["focal"].append(np.array([camera.fx, camera.fy]))
            answers["confidence"].append(1.0 + np.exp(rng.uniform(1.0, 3.0, (HEIGHT, WIDTH))))
            tokens.append(context)
        answers["tokens"] = tokens
        return {name: torch.from_numpy(np.stack(values)).float()[None] for name, values in answers.items()}


class TruthBackbone(TorchBackbone):
    """Knows photographs by their names; `fitting` images go into memory, `stray` spoils what it is a reference for."""

    card = ModelCard(
        name="truth",
        module="torch",
        install="pip install truth-model",
        code_licence="MIT",
        weights_licence="CC BY 4.0",
        weights_source="Download truth.safetensors.",
        confidence_threshold=0.5,
        memory_gib=0.1,
    )
    survey: ClassVar[Survey]
    fitting: ClassVar[int] = 99
    stray: ClassVar[int | None] = None
    made: ClassVar[list[TruthBackbone]] = []

    def prepare(self, image: WorkingImage) -> NetworkImage:
        names = [view.name for view in self.survey.views]
        resized = network_image(image, WIDTH, HEIGHT, "BICUBIC")
        painted = np.full_like(resized.rgb, STEP * names.index(image.shot.name))
        return NetworkImage(painted, resized.grid_from_photo)

    def build(self, state: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        self.made.append(self)
        return TrueNetwork(self.survey), state

    def predict(self, network: TrueNetwork, images: torch.Tensor) -> Prediction:
        if images.shape[1] > self.fitting:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        answer = network(images)
        numbers = network.calls[-1]
        focal = to_numpy(answer["focal"][0])
        middle = np.broadcast_to([0.5 * WIDTH, 0.5 * HEIGHT], focal.shape)
        intrinsics = np.concatenate([focal, middle], axis=1)
        depth, tokens = to_numpy(answer["depth"][0]), to_numpy(answer["tokens"][0])
        before = {number for call in network.calls[:-1] for number in call}
        if self.stray in numbers and self.stray in before:  # it confuses the network about what is new
            tokens = np.where(np.equal(numbers, self.stray)[:, None], -tokens, tokens)
            depth[[n not in before for n in numbers]] *= 1.5
        return Prediction(
            local_from_cam=rigid_inverse(to_numpy(answer["cam_from_local"][0])),
            points_cam=unproject(depth, intrinsics),
            confidence=confidence_from_one_plus_exp(to_numpy(answer["confidence"][0])),
            intrinsics=intrinsics,
            tokens=tokens,
        )


def install(folder: Path, name: str, target: str) -> None:
    """Write what an installer leaves of a package that announces one backbone."""
    written = folder / f"{name.replace('-', '_')}_model-1.0.dist-info"
    written.mkdir(parents=True)
    (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}-model\nVersion: 1.0\n")
    (written / "entry_points.txt").write_text(f"[onthefly3r.backbones]\n{name} = {target}\n")
