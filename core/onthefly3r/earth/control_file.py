"""Ground control from a file: `gcp_list.txt` of OpenDroneMap, CSV with a header, GeoJSON points."""

from __future__ import annotations

import re
from pathlib import Path

from ..errors import ReferenceFormatError
from ..files.strict_json import loads
from ..options import GeoreferenceOptions
from .control import Collected, Control, Mark, crs_of, number_of
from .control_table import COLUMNS, from_csv, table_row

MAX_FILE_BYTES = 64 * 1024 * 1024


def control_of(options: GeoreferenceOptions) -> Control | None:
    """Return the ground control that the options name, None without; raises `ReferenceFormatError`."""
    if options.control is None:
        return None
    marks = None if options.control_marks is None else Path(options.control_marks)
    return read_control(Path(options.control), options.crs, marks).with_checkpoints(options.checkpoints)


def read_control(path: Path, crs: str | None = None, marks: Path | None = None) -> Control:
    """Read ground control from `gcp_list.txt`, a .csv with a header, or .geojson/.json points.

    Args:
        path: the file; a CSV may hold points, marks, or both in every line.
        crs: that of a CSV which names none; longitude and latitude need none.
        marks: a second CSV with the marks (image, label, px, py), where `path` has the points only.

    Raises:
        ReferenceFormatError: with file, line and what to mend.
    """
    text = _text(path)
    suffix = path.suffix.lower()
    if suffix in (".geojson", ".json"):
        collected = _from_geojson(text, path)
    elif suffix == ".csv":
        collected = from_csv(text, path, crs, None)
    else:
        collected = _from_gcp_list(text, path)
    if marks is not None:
        collected = from_csv(_text(marks), marks, crs, collected)
    return collected.done()


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ReferenceFormatError(f"{path}: larger than {MAX_FILE_BYTES // 2**20} MiB")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ReferenceFormatError(f"{path} cannot be read ({error}); give ground control in UTF-8") from error


def _from_gcp_list(text: str, path: Path) -> Collected:
    """Read lines `x y z px py image [label] [more]` after one with the CRS; points without label by coordinates."""
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1)]
    lines = [(n, line) for n, line in lines if line and not line.startswith("#")]
    if len(lines) < 2:
        raise ReferenceFormatError(
            f"{path}: no control; first a line with the CRS, then x y z px py image [label] per mark"
        )
    collected = Collected(crs_of(lines[0][1], f"{path}, line {lines[0][0]}"), path)
    numbered: dict[tuple[str, ...], str] = {}
    for number, line in lines[1:]:
        where = f"{path}, line {number}"
        words = [word.strip() for word in (line.split("\t") if "\t" in line else line.split())]
        if len(words) < 6:
            raise ReferenceFormatError(f"{where}: expected x y z px py image [label], found {line[:80]!r}")
        x, y = number_of(words[0], where, "x"), number_of(words[1], where, "y")
        z = None if words[2].lower() == "nan" else number_of(words[2], where, "z")
        px, py = number_of(words[3], where, "px"), number_of(words[4], where, "py")
        key = tuple(words[:3])
        label = words[6] if len(words) > 6 and words[6] else numbered.setdefault(key, f"GCP{len(numbered) + 1}")
        collected.add_point(label, x, y, z, where)
        collected.marks.append(Mark(label, words[5], px, py, where=where))
    return collected


def _from_geojson(text: str, path: Path) -> Collected:
    """Read a FeatureCollection of points; longitude, latitude unless a `crs` member says otherwise."""
    try:
        told = loads(text)
        features = told["features"]
        named = told.get("crs", {}).get("properties", {}).get("name", "EPSG:4326")
        named = re.sub(r"urn:ogc:def:crs:EPSG:[^:]*:", "EPSG:", str(named))
        named = "EPSG:4326" if "CRS84" in named else named
        collected = Collected(crs_of(named, str(path)), path)
        for number, feature in enumerate(features, start=1):
            where = f"{path}, feature {number}"
            properties = {re.sub(r"[^a-z0-9]", "", k.lower()): v for k, v in (feature.get("properties") or {}).items()}
            cell = {
                name: str(properties[word])
                for name, known in COLUMNS.items()
                for word in known
                if properties.get(word) is not None
            }
            if feature["geometry"]["type"] != "Point":
                raise ReferenceFormatError(f"{where}: is no point but {feature['geometry']['type']}")
            x, y, *rest = feature["geometry"]["coordinates"]
            cell |= {"x": str(x), "y": str(y), "z": str(rest[0]) if rest else cell.get("z", "")}
            cell = {name: value for name, value in cell.items() if name not in ("lon", "lat")}
            cell.setdefault("label", str(feature.get("id", f"GCP{number}")))
            table_row(collected, cell, where)
            for mark in properties.get("marks") or ():
                x_px, y_px = (number_of(str(mark[name]), where, name) for name in ("x", "y"))
                collected.marks.append(Mark(cell["label"], str(mark["image"]), x_px, y_px, where=where))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ReferenceFormatError(f"{path}: is no GeoJSON collection of points ({error!r})") from error
    return collected
