"""What must be the same for a run to go on from its folder: photographs, and the options that decide its map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ..errors import InputError, OptionError
from ..options import Options, slice_classes
from ..records import Shot
from .record import RunRecord

# How the files are written and where the map lies on the Earth is decided when all is placed, and the number of
# threads decides nothing. Positions and control take part in the adjustment of the map.
FREE = {"threads", "crs", "force_crs", "local"} | {item.name for item in fields(slice_classes()["export"])}
EARTH = {item.name for item in fields(slice_classes()["georeference"])}


def require_same_map(earlier: RunRecord, options: Options, out: Path) -> None:
    """Raise `OptionError` when an option would give another map than the one that is begun."""
    free = FREE | EARTH if earlier.stage == "mapped" else FREE
    now = options.to_flat()
    for name in sorted(earlier.options.keys() & now.keys() - free - {"preset"}):
        if now[name] != earlier.options[name]:
            raise OptionError(
                f"{name}: the run in {out} that did not end was begun with {_told(earlier.options[name])}, and "
                f"{_told(now[name])} would change its map; name the same, or begin again with --anew or in another "
                "folder"
            )


def same_photographs(earlier: RunRecord, shots: Sequence[Shot], out: Path) -> list[Shot]:
    """Return the shots of an earlier run where they are now, and behind them those that are new.

    Raises `InputError` when one of the earlier run is gone, or is another photograph now.
    """
    here = {shot.name: shot for shot in shots}
    known = [earlier.shots[index] for index in sorted(earlier.shots)]
    other = [shot.name for shot in known if shot.name not in here or not _is_same(shot, here[shot.name])]
    if other:
        raise InputError(
            f"{out} holds a run that did not end, of {len(known)} photographs, of which {len(other)} are gone or "
            f"changed, first {other[0]}; 'onthefly3r resume {out}' goes on without them, --anew begins again, or name "
            "another folder"
        )
    names = {shot.name for shot in known}
    moved = [replace(shot, path=here[shot.name].path, stamp=here[shot.name].stamp) for shot in known]
    return [*moved, *(shot for shot in shots if shot.name not in names)]


def _is_same(one: Shot, other: Shot) -> bool:
    def key(shot: Shot) -> tuple[Any, ...]:
        size = None if shot.stamp is None else shot.stamp[0]
        return size, shot.width_px, shot.height_px, shot.camera_key, shot.time_s, shot.gps

    return key(one) == key(other)


def _told(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return "none" if value is None else str(value)
