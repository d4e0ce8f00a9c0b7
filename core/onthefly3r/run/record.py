"""What a run knows besides its map, on disk from its start on: every verb works from it, and a run goes on from it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from .. import __version__
from ..errors import InputError
from ..files.atomic import write_text
from ..files.strict_json import loads
from ..map.journal import shot_from_json, shot_to_json
from ..options import slice_classes
from ..records import RefusedPhotograph, Rejection, Shot

NAME = "run.json"
FORMAT = 2  # 1, of release 0.1, told neither format nor stage, and was written at the end only
MAX_BYTES = 256 * 2**20

Stage = Literal["reconstructing", "mapped"]  # mapped: every photograph was placed or refused, and the map is final
NOT_AGAIN = {"positions", "boundary", "cloud", "control", "control_marks", "checkpoints"}  # files that may be gone


@dataclass
class RunRecord:
    """One run: what it was given, and how far it is; the map itself is in the journal."""

    options: dict[str, Any]  # of `Options.to_flat`
    backbone: str
    backbone_facts: dict[str, Any]
    photos: str = ""  # folder that the photographs came from
    software: str = __version__
    stage: Stage = "reconstructing"
    error: str | None = None  # why it ended before its time
    shots: dict[int, Shot] = field(default_factory=dict)
    refused: Sequence[RefusedPhotograph] = ()
    rejections: Mapping[int, Rejection] = field(default_factory=dict)
    retries: Mapping[int, int] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()

    def write(self, work: Path) -> None:
        """Write the record into the work folder of a run; an earlier state is replaced at once."""
        told = {
            "format": FORMAT,
            "software": self.software,
            "stage": self.stage,
            "error": self.error,
            "photos": self.photos,
            "options": self.options,
            "backbone": self.backbone,
            "backbone_facts": self.backbone_facts,
            "details": dict(self.details),
            "warnings": list(self.warnings),
            "shots": {str(index): shot_to_json(shot) for index, shot in self.shots.items()},
            "retries": {str(index): count for index, count in self.retries.items()},
            "rejections": {
                str(index): {"stage": r.stage, "reason": r.reason, "numbers": dict(r.numbers)}
                for index, r in self.rejections.items()
            },
            "refused": [{"name": r.name, "reason": r.reason, "numbers": dict(r.numbers)} for r in self.refused],
        }
        write_text(work / NAME, json.dumps(told))

    @classmethod
    def read(cls, work: Path) -> RunRecord:
        """Read what `write` wrote, of release 0.1 too; raises `InputError` for anything else."""
        path = work / NAME
        stored = _load(path)
        try:
            return cls(
                options=dict(stored["options"]),
                backbone=str(stored["backbone"]),
                backbone_facts=dict(stored["backbone_facts"]),
                photos=str(stored.get("photos", "")),
                software=str(stored.get("software", "0.1.0")),
                stage="reconstructing" if stored.get("stage") == "reconstructing" else "mapped",
                error=None if stored.get("error") is None else str(stored["error"]),
                shots={int(index): shot_from_json(shot) for index, shot in stored["shots"].items()},
                refused=[RefusedPhotograph(r["name"], r["reason"], dict(r["numbers"])) for r in stored["refused"]],
                rejections={
                    int(index): Rejection((int(index),), r["stage"], r["reason"], dict(r["numbers"]))
                    for index, r in stored["rejections"].items()
                },
                retries={int(index): int(count) for index, count in stored["retries"].items()},
                details=dict(stored["details"]),
                warnings=[str(warning) for warning in stored["warnings"]],
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{path} is damaged ({error!r}); run again") from error


def earlier_options(run: Path) -> dict[str, Any]:
    """Return the options of georeferencing and export that an earlier run in `run` was made with, by name.

    Left out are its files: positions stay with the photographs of the run, and a boundary need not be there any more.
    Raises `InputError` when the folder holds no run.
    """
    path = Path(run) / "work" / NAME
    options = _load(path).get("options")
    if not isinstance(options, dict):
        raise InputError(f"{path} is no record of a run (it names no options); name the output folder of a run")
    slices = slice_classes()
    names = {item.name for name in ("georeference", "export") for item in fields(slices[name])}
    return {name: options[name] for name in names - NOT_AGAIN if name in options}


def _load(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"larger than {MAX_BYTES} bytes")
        stored = loads(path.read_text(encoding="utf-8"))
        if not isinstance(stored, dict):
            raise ValueError("no JSON object")
        if int(stored.get("format", 1)) > FORMAT:
            raise ValueError(f"written by a later release, {stored.get('software')}: use that one")
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is no record of a run ({error}); name the output folder of a run") from error
    return stored
