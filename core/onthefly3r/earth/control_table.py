"""Ground control in tables: CSV with a header, whatever its columns are called."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ..errors import ReferenceFormatError
from .control import Collected, Mark, crs_of, number_of

# Header words of CSV files, without case, blanks and punctuation; Metashape's, Pix4D's and everyday ones.
COLUMNS = {
    "label": ("label", "name", "marker", "markerlabel", "point", "pointname", "gcp", "gcpname", "gcplabel", "id"),
    "image": ("image", "imagename", "photo", "file", "filename", "camera", "cameralabel"),
    "px": ("px", "pixelx", "xpx", "u", "imagex", "imx", "col", "column", "projectionx", "xprojection", "xproj"),
    "py": ("py", "pixely", "ypx", "v", "imagey", "imy", "row", "line", "projectiony", "yprojection", "yproj"),
    "x": ("x", "e", "east", "easting", "xeasting", "xest", "xlongitude", "geox", "xm", "eastingm"),
    "y": ("y", "n", "north", "northing", "ynorthing", "yest", "ylatitude", "geoy", "ym", "northingm"),
    "lon": ("lon", "long", "longitude", "lng"),
    "lat": ("lat", "latitude"),
    "z": ("z", "h", "height", "alt", "altitude", "elevation", "elev", "zaltitude", "geoz", "zm", "heightm"),
    "sigma_h": (
        "sigmah",
        "sigmahm",
        "sigmaxy",
        "accuracyh",
        "accuracyhorz",
        "horizontalaccuracy",
        "hacc",
        "accuracyxym",
    ),
    "sigma_v": ("sigmav", "sigmavm", "sigmaz", "accuracyv", "accuracyvert", "verticalaccuracy", "vacc", "accuracyzm"),
    "sigma": ("sigma", "sigmam", "accuracy", "accuracym", "accuracyxyzm"),
    "role": ("type", "role", "kind", "use", "checkpoint"),
    "width": ("imagewidth", "width", "widthpx"),
}
_CHECK_WORDS = ("check", "checkpoint", "chk", "cp", "true", "yes", "1")


def from_csv(text: str, path: Path, crs: str | None, before: Collected | None) -> Collected:
    """Read a table with a header; every line may hold a point, a mark, or both."""
    number, header, rows, told = _table(text, path)
    column = _mapped(header)
    if "label" not in column or not ({"x", "y"} <= set(column) or {"lon", "lat"} <= set(column) or "px" in column):
        raise ReferenceFormatError(
            f"{path}, line {number}: the header must name the label and coordinates (x y z, or longitude latitude "
            f"height) or marks (image px py); found {', '.join(header)[:200]}"
        )
    geographic = "lon" in column
    collected = before
    if collected is None:
        named = told or ("EPSG:4326" if geographic else crs)
        if named is None:
            raise ReferenceFormatError(
                f"{path}: does not say what its coordinates refer to; write a line '# EPSG:32633' above the header, or "
                "give the option crs"
            )
        collected = Collected(crs_of(named, str(path)), path)
    for line, row in rows:
        table_row(
            collected, {name: row[k].strip() for name, k in column.items() if k < len(row)}, f"{path}, line {line}"
        )
    return collected


def table_row(collected: Collected, cell: Mapping[str, str], where: str) -> None:
    """Take one line, its cells by what they hold: a point, a mark, or both."""
    label = cell.get("label", "")
    if not label:
        raise ReferenceFormatError(f"{where}: the label is missing")
    x, y = (cell.get("lon", ""), cell.get("lat", "")) if "lon" in cell else (cell.get("x", ""), cell.get("y", ""))
    if x and y:
        z = cell.get("z", "")
        both = _sigma(cell, "sigma", where)
        collected.add_point(
            label,
            number_of(x, where, "x"),
            number_of(y, where, "y"),
            number_of(z, where, "height") if z and z.lower() != "nan" else None,
            where,
            sigma_h_m=_sigma(cell, "sigma_h", where) or both,
            sigma_v_m=_sigma(cell, "sigma_v", where) or both,
            checkpoint=True if cell.get("role", "").lower() in _CHECK_WORDS else None,
        )
    if cell.get("image") and cell.get("px") and cell.get("py"):
        width = cell.get("width")
        collected.marks.append(
            Mark(
                label,
                cell["image"],
                number_of(cell["px"], where, "px"),
                number_of(cell["py"], where, "py"),
                number_of(width, where, "width") if width else None,
                where,
            )
        )


def _sigma(cell: Mapping[str, str], name: str, where: str) -> float | None:
    if not cell.get(name):
        return None
    value = number_of(cell[name], where, "an accuracy")
    if not value > 0.0:
        raise ReferenceFormatError(f"{where}: an accuracy must be greater than 0, not {value:g}")
    return value


def _table(text: str, path: Path) -> tuple[int, list[str], list[tuple[int, list[str]]], str | None]:
    """Return the header with its line number, the rows with theirs, and the CRS that a comment names."""
    told, header, number, rows = None, None, 0, []
    delimiter = max(",;\t", key=lambda mark: max((line.count(mark) for line in text.splitlines()[:5]), default=0))
    for n, row in _csv_rows(text, delimiter, path):
        line = delimiter.join(row).strip()
        if not line.strip(delimiter + " "):
            continue
        words = [word.strip().lstrip("#").strip() for word in row]
        if header is None:
            code = re.search(r"EPSG:+\s*(\d{4,6})|(\+proj=\S.*)|(WGS\s*84\s+UTM\s+\d{1,2}\s*[NS])", line, re.IGNORECASE)
            if code:
                told = f"EPSG:{code[1]}" if code[1] else code[2] or code[3]
            elif "label" in _mapped(words):
                header, number = words, n
            elif not line.startswith("#"):
                raise ReferenceFormatError(
                    f"{path}, line {n}: expected a header such as label,x,y,z,image,px,py; found {line[:80]!r}"
                )
        elif not line.startswith("#"):
            rows.append((n, row))
    if header is None:
        raise ReferenceFormatError(f"{path}: has no header such as label,x,y,z,image,px,py")
    return number, header, rows, told


def _csv_rows(text: str, delimiter: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(text.splitlines(), delimiter=delimiter)
    try:
        for row in reader:
            yield reader.line_num, row
    except csv.Error as error:
        raise ReferenceFormatError(f"{path}, line {reader.line_num}: {error}") from error


def _mapped(header: Sequence[str]) -> dict[str, int]:
    """Return which column holds what."""
    words = [re.sub(r"[^a-z0-9]", "", word.lower()) for word in header]
    found: dict[str, int] = {}
    for name, known in COLUMNS.items():
        places = [words.index(word) for word in known if word in words]
        if places:
            found[name] = places[0]
    return found
