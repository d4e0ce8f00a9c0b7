"""Weights of neural networks: found by path or hub id, read without pickle, loaded strictly."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import MissingDependencyError, OptionError
from ..files.strict_json import loads

FILE_NAMES = ("model.safetensors", "model.pt", "model.pth")
SUFFIXES = (".safetensors", ".pt", ".pth", ".bin", ".ckpt")
MAX_CONFIG_BYTES = 1 << 20
HUB_ID = re.compile(r"(?P<repository>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?")


@dataclass(frozen=True)
class Fingerprint:
    """Which weights a network ran with: enough to find them again and to know them from others."""

    file: str  # name without folder
    source: str  # hub id, or the file name again
    revision: str | None  # of the hub
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Weights:
    """A file of weights, and what `config.json` beside it says."""

    path: Path
    source: str  # hub id, or file name
    revision: str | None = None  # of the hub
    config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """File name, or hub id and revision."""
        return f"{self.source}@{self.revision}" if self.revision else self.source

    def fingerprint(self) -> Fingerprint:
        """Read the whole file once and return what the report says of it."""
        digest = hashlib.sha256()
        with self.path.open("rb") as stream:
            while block := stream.read(1 << 22):
                digest.update(block)
        return Fingerprint(self.path.name, self.source, self.revision, self.path.stat().st_size, digest.hexdigest())


def weights_folder() -> Path:
    """Return the folder searched when no weights are named: `$ONTHEFLY3R_WEIGHTS` or ~/.cache/onthefly3r."""
    return Path(os.environ.get("ONTHEFLY3R_WEIGHTS") or Path.home() / ".cache" / "onthefly3r")


def local_weights(name: str) -> Path | None:
    """Return the file or folder `<weights folder>/<name>`, with any usual suffix, or None."""
    folder = weights_folder()
    candidates = [folder / f"{name}{suffix}" for suffix in SUFFIXES] + [folder / name]
    return next((path for path in candidates if path.exists()), None)


def find_weights(
    name: str, chosen: str | None, get_them: str, hub_files: Sequence[str] = FILE_NAMES, option: str = "--weights"
) -> Weights:
    """Find the weights of model `name`: a path, `owner/name@revision` of the hub, or the weights folder.

    Raises `OptionError` with `get_them` (a sentence) when there are none; `option` is what names them.
    """
    if chosen is None:
        path = local_weights(name)
        if path is None:
            raise OptionError(
                f"{name}: no weights. {get_them} Then give {option} PATH, "
                f"or put the file at {weights_folder() / (name + '.safetensors')}."
            )
        return _at_path(path)
    if Path(chosen).expanduser().exists():
        return _at_path(Path(chosen).expanduser())
    match = HUB_ID.fullmatch(chosen)
    if match is None or Path(chosen).suffix in SUFFIXES:
        raise OptionError(f"weights: {chosen}: no such file. {get_them}")
    if match["revision"] is None:
        raise OptionError(
            f"weights: {chosen}: no such file or folder; for a model of the hub name the revision too, "
            f"so that a later run gives the same result: {chosen}@COMMIT"
        )
    return _from_hub(match["repository"], match["revision"], hub_files)


def read_state(path: Path) -> dict[str, Any]:
    """Read a state dict as CPU tensors; raises `OptionError` for what is none. Never unpickles objects."""
    import torch

    safe = path.suffix == ".safetensors"
    if safe and importlib.util.find_spec("safetensors") is None:
        raise MissingDependencyError(f"weights: {path}: reading it needs safetensors: pip install safetensors")
    try:
        if safe:
            from safetensors.torch import load_file

            state = dict(load_file(path))
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # truncated, no such format, other Python objects: each library has its own classes
        raise OptionError(
            f"weights: {path}: cannot be read ({_first_line(error)}); give a safetensors file, or a PyTorch file "
            "of tensors alone, and download it again if it is one"
        ) from error
    for key in ("state_dict", "model_state_dict", "model"):
        if isinstance(state, dict) and isinstance(state.get(key), dict):
            state = state[key]
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise OptionError(f"weights: {path}: holds no table of tensors (state dict); give the model's weights file")
    return state


def without_prefix(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the state without a prefix that all its keys share."""
    if all(key.startswith(prefix) for key in state):
        return {key[len(prefix) :]: value for key, value in state.items()}
    return dict(state)


def load_strict(network: Any, state: Mapping[str, Any], where: str, spare: Sequence[str] = ()) -> None:
    """Load a state dict so that every parameter gets its value; keys below `spare` prefixes may be left over.

    Raises `OptionError` that lists missing and unexpected keys, wrong shapes, or values that are not finite.
    """
    import torch

    try:
        result = network.load_state_dict(dict(state), strict=False)
    except RuntimeError as error:
        raise OptionError(
            f"weights: {where}: shapes do not fit this model: {' '.join(str(error).split())[:400]}"
        ) from error
    unexpected = [key for key in result.unexpected_keys if not key.startswith(tuple(spare))]
    own = network.state_dict()
    loaded = {own[key].data_ptr() for key in state if key in own}  # tied tensors are stored under one name only
    missing = [key for key in result.missing_keys if own[key].data_ptr() not in loaded]
    if missing or unexpected:
        raise OptionError(
            f"weights: {where}: not the weights of this model: "
            f"{_listed('missing', missing)}; {_listed('unexpected', unexpected)}"
        )
    values = {**dict(network.named_parameters()), **dict(network.named_buffers())}
    broken = [key for key, value in values.items() if value.is_floating_point() and not torch.isfinite(value).all()]
    if broken:
        raise OptionError(f"weights: {where}: values that are no numbers: {_listed('in', broken)}; download it again")


def _listed(what: str, keys: Sequence[str], most: int = 6) -> str:
    more = f" and {len(keys) - most} more" if len(keys) > most else ""
    return f"{len(keys)} {what}" + (f" ({', '.join(keys[:most])}{more})" if keys else "")


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def _at_path(path: Path) -> Weights:
    if path.is_dir():
        files = [path / name for name in FILE_NAMES if (path / name).is_file()]
        files = files or sorted(item for item in path.iterdir() if item.suffix in SUFFIXES)
        if not files:
            raise OptionError(f"weights: {path}: the folder holds none of {', '.join(FILE_NAMES)}")
        path = files[0]
    return Weights(path, path.name, config=_config(path.with_name("config.json")))


def _config(path: Path) -> dict[str, Any]:
    if not path.is_file() or path.stat().st_size > MAX_CONFIG_BYTES:
        return {}
    try:
        content = loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise OptionError(f"{path}: not JSON ({error}); download it again") from error
    return content if isinstance(content, dict) else {}


def _from_hub(repository: str, revision: str, names: Sequence[str]) -> Weights:
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"weights: {repository}@{revision}: downloading needs huggingface_hub: pip install huggingface_hub; "
            "or download the file yourself and give --weights PATH"
        ) from error
    try:
        available = huggingface_hub.list_repo_files(repository, revision=revision)
        name = next((item for item in names if item in available), None)
        if name is None:
            raise OptionError(f"weights: {repository}@{revision}: holds none of {', '.join(names)}")
        path = Path(huggingface_hub.hf_hub_download(repository, name, revision=revision))
        if "config.json" in available:
            huggingface_hub.hf_hub_download(repository, "config.json", revision=revision)
    except OptionError:
        raise
    except Exception as error:  # network, permission and revision errors have no common class
        raise OptionError(f"weights: {repository}@{revision}: cannot be downloaded ({_first_line(error)})") from error
    return Weights(path, repository, revision, _config(path.with_name("config.json")))
