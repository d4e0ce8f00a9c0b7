"""Processing parameters from the core's option declarations, so that no option is written twice."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

from ..core.onthefly3r.options import Preset, iterate_options
from .base import tr

# Names of the parameters that are not options of the core.
QUALITY, CRS, POSITIONS, PRESET = "QUALITY", "CRS", "POSITIONS", "PRESET"

# The presets set these; whoever names one of them in the advanced parameters overrides the preset.
QUALITIES: dict[str, dict[str, int]] = {
    "preview": {"working_px": 600, "dense_px": 250, "features": 2000},
    "standard": {},
    "full": {"working_px": 1600, "dense_px": 1000, "features": 8000},
}
# With parameters of their own, or of no use in QGIS.
NOT_SHOWN = {"crs", "boundary", "backbone", "vertical", "positions", "cloud"}
AS_BEFORE = "as before"
UNITS = ("m", "px", "mm", "deg", "GiB")  # shown in titles; the others only say what is counted
# Titles where the option's name alone says too little to somebody who does not know the command line.
TITLES = {
    "recursive": "Search sub-folders too",
    "min_side_px": "Shortest side allowed",
    "limit": "Use only the first photographs",
    "focal_35mm": "Focal length, 35-mm equivalent",
    "working_px": "Size of the photographs while reconstructing",
    "dense_px": "Size of the point maps",
    "threads": "Processor cores",
    "local": "Map units, no coordinate reference system",
    "gps_sigma_h_m": "Accuracy of positions, horizontal",
    "gps_sigma_v_m": "Accuracy of positions, vertical",
    "format": "Format of the point cloud",
    "spacing_m": "Distance of points",
    "min_confidence": "Least confidence of a point, 0 to 1",
    "stray_filter": "Drop isolated points",
}
BACKBONES = ("classical", "da3", "pi3", "pi3x", "vggt", "vggt-omega", "mapanything")


def add(algorithm: QgsProcessingAlgorithm, parameter: QgsProcessingParameterDefinition, help: str, advanced=False):
    """Add a parameter with its help."""
    parameter.setHelp(help)
    if advanced:
        parameter.setFlags(parameter.flags() | QgsProcessingParameterDefinition.Flag.FlagAdvanced)
    algorithm.addParameter(parameter)


def add_quality(algorithm: QgsProcessingAlgorithm) -> None:
    """Add the quality preset."""
    add(
        algorithm,
        words_parameter(QUALITY, tr("Quality"), tuple(QUALITIES), "standard"),
        tr(
            "preview: coarse and fast, to see whether the flight is complete. standard: the usual choice. "
            "full: more detail, several times the time and memory."
        ),
    )


def add_backbone(algorithm: QgsProcessingAlgorithm) -> None:
    """Add the choice of the local reconstructor."""
    add(
        algorithm,
        words_parameter("BACKBONE", tr("Local reconstructor (backbone)"), BACKBONES, "classical"),
        tr(
            "classical needs no graphics card and no downloads. The others are neural networks: they need the neural "
            "packages in the environment, their weights, and their authors' licences."
        ),
    )


def add_target_crs(algorithm: QgsProcessingAlgorithm, again: bool = False) -> None:
    """Add the target CRS; `again` for a run that has one already."""
    empty = tr("that of the run is kept") if again else tr("the UTM zone of the photographs' median position is taken")
    add(
        algorithm,
        QgsProcessingParameterCrs(CRS, tr("Coordinate reference system"), optional=True),
        tr("Projected, in metres. Left empty, {}.").format(empty),
    )


def add_georeference(algorithm: QgsProcessingAlgorithm, again: bool = False) -> None:
    """Add the target CRS, the height reference and a position file; `again` for a run that has them already."""
    add_target_crs(algorithm, again)
    choices = next(item for _, item in iterate_options() if item.name == "vertical").metadata["choices"]
    add(
        algorithm,
        words_parameter(
            "VERTICAL",
            tr("Height reference"),
            (AS_BEFORE, *choices) if again else choices,
            AS_BEFORE if again else "auto",
        ),
        tr(
            "What the heights in the photographs refer to; the results keep it. auto decides from the tags and says "
            "so in the report. ellipsoidal: above WGS 84. egm96, egm2008: above mean sea level (geoid)."
        ),
    )
    add(
        algorithm,
        QgsProcessingParameterFile(
            POSITIONS, tr("Position file"), QgsProcessingParameterFile.Behavior.File, optional=True
        ),
        tr(
            "A text file (geo.txt) that replaces the positions in the photographs: first a line with the CRS, such as "
            "EPSG:4326, then 'name x y [z] [yaw pitch roll] [accuracies: horizontal vertical]' for each photograph."
        ),
        advanced=not again,
    )


def add_all_options(algorithm: QgsProcessingAlgorithm) -> None:
    """Add the core's options that have no parameter of their own, as advanced ones; empty means the core's default."""
    add(
        algorithm,
        words_parameter(PRESET, tr("Defaults"), get_args(Preset), "default"),
        tr("Whose defaults are taken where nothing is named: ours, or those of the paper that the method is from."),
        advanced=True,
    )
    for _, item in iterate_options():
        if item.name not in NOT_SHOWN:
            add(algorithm, option_parameter(item), option_help(item), advanced=True)


def add_options(algorithm: QgsProcessingAlgorithm, *names: str) -> None:
    """Add some of the core's options as ordinary parameters."""
    for _, item in iterate_options():
        if item.name in names:
            add(algorithm, option_parameter(item), option_help(item))


def option_parameter(item: dataclasses.Field) -> QgsProcessingParameterDefinition:
    """Return the parameter of one option, named like it in capitals."""
    facts, name, kind = item.metadata, item.name.upper(), str(item.type)
    title = tr(TITLES.get(item.name) or plain_title(item.name))
    if facts["unit"] in UNITS:
        title += f" [{facts['unit']}]"
    if facts["choices"]:
        return words_parameter(name, title, facts["choices"], item.default)
    if kind == "bool":
        return QgsProcessingParameterBoolean(name, title, defaultValue=item.default)
    if kind.startswith(("int", "float")):
        types = QgsProcessingParameterNumber.Type
        number = types.Integer if kind.startswith("int") else types.Double
        parameter = QgsProcessingParameterNumber(name, title, number, optional=True)
        if facts["minimum"] is not None:
            parameter.setMinimum(facts["minimum"])
        if facts["maximum"] is not None:
            parameter.setMaximum(facts["maximum"])
        # Empty instead of the default, so that the quality preset can tell what the user named.
        parameter.setDefaultValue(None)
        return parameter
    return QgsProcessingParameterString(name, title, optional=True)


def plain_title(name: str) -> str:
    """Return an option's name as words, without the unit that it ends in."""
    words = name.split("_")
    words = words[:-1] if words[-1] in ("m", "px", "deg", "gib") else words
    words = [word.upper() if word in ("gps", "gpu") else word for word in words]
    return " ".join([words[0][0].upper() + words[0][1:], *words[1:]])


def option_help(item: dataclasses.Field) -> str:
    """Return an option's help with its default."""
    text = tr(item.metadata["help"])
    text = text[0].upper() + text[1:] + "."
    numeric = str(item.type).startswith(("int", "float"))
    if numeric and item.default is not None:
        text += " " + tr("Empty: {}.").format(f"{item.default} {item.metadata['unit']}".strip())
    return text


def words_parameter(name: str, title: str, words: Iterable[str], default: str) -> QgsProcessingParameterEnum:
    """Return a choice whose values are the words themselves, in scripts and on the command line too."""
    return QgsProcessingParameterEnum(name, title, list(words), False, default, False, True)


def options_from(
    algorithm: QgsProcessingAlgorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    every: bool = False,
) -> dict[str, Any]:
    """Return the core's options by name from an algorithm's parameters: the presets first, named ones over them.

    With `every`, those that have the core's default are named too: needed where they replace those of an earlier run.
    """
    options: dict[str, Any] = {}
    if algorithm.parameterDefinition(PRESET) is not None:
        preset = algorithm.parameterAsEnumString(parameters, PRESET, context)
        options.update({} if preset == "default" else {"preset": preset})
    if algorithm.parameterDefinition(QUALITY) is not None:
        options.update(QUALITIES[algorithm.parameterAsEnumString(parameters, QUALITY, context)])
    for _, item in iterate_options():
        definition = algorithm.parameterDefinition(item.name.upper())
        if definition is None or item.name in ("crs", "boundary"):
            continue
        value = _value(algorithm, definition, parameters, context)
        if value == AS_BEFORE:
            continue
        if value is not None and (value != item.default or every):
            options[item.name] = value
        elif value is not None and parameters.get(definition.name()) is not None:
            options.pop(item.name, None)  # the user named the default, against the preset
    crs = crs_text(algorithm.parameterAsCrs(parameters, CRS, context)) if algorithm.parameterDefinition(CRS) else None
    if crs:
        options["crs"] = crs
    return options


def _value(algorithm, definition, parameters, context) -> Any:
    name = definition.name()
    if isinstance(definition, QgsProcessingParameterBoolean):
        return algorithm.parameterAsBoolean(parameters, name, context)
    if isinstance(definition, QgsProcessingParameterEnum):
        return algorithm.parameterAsEnumString(parameters, name, context)
    if isinstance(definition, QgsProcessingParameterNumber):
        if parameters.get(name) in (None, ""):
            return None
        if definition.dataType() == QgsProcessingParameterNumber.Type.Integer:
            return algorithm.parameterAsInt(parameters, name, context)
        return algorithm.parameterAsDouble(parameters, name, context)
    return algorithm.parameterAsString(parameters, name, context) or None


def crs_text(crs: QgsCoordinateReferenceSystem) -> str | None:
    """Return a CRS as PROJ reads it; raises `QgsProcessingException` for one that cannot carry a survey."""
    if not crs.isValid():
        return None
    if crs.isGeographic():
        raise QgsProcessingException(
            tr("{} is in degrees: choose a projected CRS in metres, or leave it empty for the UTM zone.").format(
                crs.authid() or crs.description()
            )
        )
    return crs.authid() if not crs.authid().startswith("USER:") and crs.authid() else crs.toWkt()


def require_folder(path: str, what: str) -> Path:
    """Return the folder; raises `QgsProcessingException` when it is none."""
    folder = Path(path)
    if not path or not folder.is_dir():
        raise QgsProcessingException(tr("{}: {} is no folder.").format(what, path or tr("nothing")))
    return folder
