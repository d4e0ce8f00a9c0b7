"""What every network needs of torch: device, precision, memory, tensors to arrays; torch is imported when used."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..errors import OptionError
from ..geometry.arrays import Float

GIB = float(1 << 30)
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def select_device(name: str) -> Any:
    """Return the torch device of `auto`, `cuda`, `mps` or `cpu`; raises `OptionError` for one that is not there."""
    import torch

    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        return torch.device(next(kind for kind, there in available.items() if there))
    if not available[name]:
        raise OptionError(f"device: {name} is not available to torch {torch.__version__} here; choose auto or cpu")
    return torch.device(name)


def autocast_dtype(device: Any) -> Any:
    """Return the reduced precision of a device: bf16 from compute capability 8, else fp16; None keeps fp32."""
    import torch

    if device.type != "cuda":
        return None
    return torch.bfloat16 if torch.cuda.get_device_capability(device)[0] >= 8 else torch.float16


def limit_gpu_memory(device: Any, limit_gib: float | None) -> None:
    """Cap what torch may take of the GPU's memory."""
    import torch

    if limit_gib is not None and device.type == "cuda":
        total = torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(1.0, limit_gib * GIB / total), device)


def is_out_of_memory(error: BaseException) -> bool:
    """Say whether an error means that a device's memory ran out."""
    import torch

    text = str(error).lower()
    return isinstance(error, torch.OutOfMemoryError) or any(
        phrase in text for phrase in ("out of memory", "not enough memory", "can't allocate memory")
    )


def release_memory(device: Any) -> None:
    """Give cached GPU memory back after it ran out."""
    import gc

    import torch

    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
    elif device.type == "mps":
        torch.mps.empty_cache()


def to_numpy(tensor: Any) -> Float:
    """Return a tensor as a float32 array on the host."""
    return np.asarray(tensor.detach().float().cpu().numpy())


def imagenet_normalised(images: Any) -> Any:
    """Return images (..., 3, H, W) in 0..1 with ImageNet's mean and standard deviation per channel taken out."""
    mean, std = (images.new_tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std


@contextmanager
def captured(module: Any, pick: Callable[[Any], Any]) -> Iterator[list[Any]]:
    """Collect `pick(output)` of every call of a sub-module, for tokens that a network does not return."""
    kept: list[Any] = []
    handle = module.register_forward_hook(lambda _module, _inputs, output: kept.append(pick(output)))
    try:
        yield kept
    finally:
        handle.remove()


@contextmanager
def quiet_upstream() -> Iterator[None]:
    """Keep upstream prints out of standard output, which carries events, and its warnings from the user."""
    with contextlib.redirect_stdout(sys.stderr), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
