"""Our own run on a scene of a data set, with its results where `compare` looks for them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from onthefly3r.errors import InputError
from onthefly3r.options import Options
from onthefly3r.run.session import reconstruct

from .datasets import Scene
from .measured import SceneResult, measure


def run_scene(scene: Scene, method: Path, given: Mapping[str, Any]) -> SceneResult:
    """Reconstruct a scene into METHOD/SCENE in map units, and measure it.

    Only the scene's own frames are used (a data set may hold more): they are linked into METHOD/SCENE-photos.

    Raises what `reconstruct` raises.
    """
    photos = method / f"{scene.name}-photos"
    link_photographs(scene, photos)
    reconstruct(photos, method / scene.name, Options.from_flat({"local": True, "gps_candidates": False, **given}))
    return measure(method, scene)


def link_photographs(scene: Scene, folder: Path) -> None:
    """Make a folder of links to the images of a scene, under the names by which the reference knows them.

    Raises `InputError` when a name leads out of the folder or is taken by something else.
    """
    for name, path in zip(scene.names, scene.images, strict=True):
        link = folder / name
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise InputError(f"{name}: an image name of {scene.name} leads out of {folder}")
        link.parent.mkdir(parents=True, exist_ok=True)
        if link.is_symlink():
            link.unlink()
        elif link.exists():
            raise InputError(f"{link}: exists and is no link; name another folder")
        link.symlink_to(path.resolve())
