"""What a survey is called, and where its results go when nobody says.

Standard library only; paths may be those of another system, so that Windows is tested everywhere.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import TypeVar
from urllib.parse import quote

Place = TypeVar("Place", bound=PurePath)

# Names that cameras and habits give to folders of photographs; they tell one survey from another as little as "DCIM".
_SAYS_NOTHING = re.compile(
    r"photos?|photographs?|images?|imgs?|pictures?|pics|fotos?|bilder|jpe?gs?|raw|rgb|input|dcim|\d{3}[a-z0-9_]{5}",
    re.IGNORECASE,
)
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*\x00-\x1f]+')
RESULTS = "reconstructed"
LITTER = {".DS_Store", "Thumbs.db", "desktop.ini", ".directory"}  # of file managers


def survey_name(photos: PurePath) -> str:
    """Return the name of a survey from its folder of photographs: the first name upwards that says something.

    `E:\\2026-05 quarry\\DCIM\\100MEDIA` is "2026-05 quarry"; a card's own root gives the letter of its drive.
    """
    names = [name for name in (place.name for place in (photos, *photos.parents)) if name]
    telling = [name for name in names if not _SAYS_NOTHING.fullmatch(name)]
    named = telling[0] if telling else names[0] if names else photos.drive
    return _NOT_IN_NAMES.sub(" ", named).strip(" .") or "survey"


def default_output(
    photos: Path,
    project_folder: Path | None,
    documents: Path,
    is_writable: Callable[[Path], bool] | None = None,
    what: str = RESULTS,
) -> Path:
    """Return a folder for the results that is not there yet, or is empty.

    It lies beside the photographs; where these are on a card or nothing can be written there, in the folder of the
    project, else in the documents. Its name ends in `what`.
    """
    writable = is_writable or can_write
    beside = photos.parent
    on_a_card = beside == beside.parent or any(part.upper() == "DCIM" for part in photos.parts)
    places = [None if on_a_card else beside, project_folder]
    parent = next((place for place in places if place is not None and writable(place)), documents / "On-the-Fly3R")
    name = survey_name(photos).replace(f" {RESULTS}", "")
    return unused(parent, f"{name} {what}")


def unused(parent: Path, name: str) -> Path:
    """Return the first of `name`, `name 2`, `name 3` … in `parent` that is missing or an empty folder."""
    return next(place for place in _numbered(parent, name) if is_free(place))


def is_free(place: Path) -> bool:
    """Return whether nothing is there, or an empty folder."""
    try:
        return not os.path.lexists(place) or (place.is_dir() and all(inner.name in LITTER for inner in place.iterdir()))
    except OSError:
        return False


def can_write(folder: Path) -> bool:
    """Return whether new files may be made in a folder."""
    return folder.is_dir() and os.access(folder, os.W_OK)


def file_url(path: PurePath | str) -> str:
    """Return the address of a local file for pages and map tips: drive letters and network shares too."""
    text = str(path).replace("\\", "/") if re.match(r"[A-Za-z]:[\\/]|\\\\", str(path)) else str(path)
    quoted = quote(text, safe="/:")
    if text.startswith("//"):  # \\server\share
        return f"file:{quoted}"  # file://server/share
    return f"file://{quoted}" if text.startswith("/") else f"file:///{quoted}"


def _numbered(parent: Path, name: str) -> Iterator[Path]:
    yield parent / name
    number = 2
    while True:
        yield parent / f"{name} {number}"
        number += 1
