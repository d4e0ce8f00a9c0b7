"""What an export takes over from the run that it exports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from onthefly3r.errors import InputError
from onthefly3r.options import Options
from onthefly3r.run.record import earlier_options


def write(folder: Path, text: str) -> None:
    (folder / "work").mkdir()
    (folder / "work" / "run.json").write_text(text, encoding="utf-8")


def test_georeferencing_and_export_stay_as_they_were_but_not_its_files(tmp_path: Path) -> None:
    named = {"crs": "EPSG:25833", "vertical": "egm96", "spacing_m": 0.3, "format": "las", "stray_filter": False}
    files = {"boundary": "gone.geojson", "positions": "geo.txt", "cloud": False, "seed_size": 12}
    write(tmp_path, json.dumps({"options": {**Options().to_flat(), **named, **files}}))
    kept = earlier_options(tmp_path)
    assert Options.from_flat(kept) == Options.from_flat(named)
    assert not set(files) & set(kept)


def test_options_of_an_older_version_may_lack_some(tmp_path: Path) -> None:
    write(tmp_path, json.dumps({"options": {"vertical": "egm96", "an_option_of_old": 3}}))
    assert earlier_options(tmp_path) == {"vertical": "egm96"}


@pytest.mark.parametrize("text", [None, "{", "[]", '{"shots": {}}'])
def test_folder_that_is_no_run(text: str | None, tmp_path: Path) -> None:
    if text is not None:
        write(tmp_path, text)
    with pytest.raises(InputError, match="is no record of a run"):
        earlier_options(tmp_path)
