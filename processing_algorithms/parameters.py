"""Processing parameters from the core's option declarations, so that no option is written twice."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

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
    QgsUnitTypes,
)

from ..core.onthefly3r.errors import OptionError
from ..core.onthefly3r.options import Options, iterate_options
from .base import chosen_word, tr
from .option_text import read_options

# Names of the parameters that are not options of the core.
QUALITY, CRS, OPTIONS = "QUALITY", "CRS", "OPTIONS"
# Those of options that name a file of the user.
FILES = ("POSITIONS", "CONTROL")

# A quality sets these beside the core's own option of that name; further options go before them.
QUALITIES: dict[str, dict[str, Any]] = {
    "preview": {"working_px": 600, "dense_px": 250, "features": 2000, "orthophoto": "fast"},
    "standard": {},
    "full": {"working_px": 1600, "dense_px": 1000, "features": 8000},
}
AS_BEFORE = "as before"
UNITS = ("m", "px", "mm", "deg", "GiB")  # shown in titles; the others only say what is counted
# Titles where the option's name alone says too little to somebody who does not know the command line.
TITLES = {
    "gps_sigma_h_m": "Accuracy of positions, horizontal",
    "gps_sigma_v_m": "Accuracy of positions, vertical",
    "local": "Map units, no coordinate reference system",
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
            "POSITIONS", tr("Position file"), QgsProcessingParameterFile.Behavior.File, optional=True
        ),
        tr(
            "A text file (geo.txt) that replaces the positions in the photographs: first a line with the CRS, such as "
            "EPSG:4326, then 'name x y [z] [yaw pitch roll] [accuracies: horizontal vertical]' for each photograph."
        ),
        advanced=not again,
    )


def add_control(algorithm: QgsProcessingAlgorithm) -> None:
    """Add the file of ground control."""
    add(
        algorithm,
        QgsProcessingParameterFile(
            "CONTROL", tr("Ground control"), QgsProcessingParameterFile.Behavior.File, optional=True
        ),
        tr(
            "Points that were surveyed on the ground and marked in the photographs: gcp_list.txt, a CSV with the "
            "columns label, x, y, z, image, px, py, or GeoJSON. Labels that begin with CHK- only check the result."
        ),
    )


def add_further_options(algorithm: QgsProcessingAlgorithm) -> None:
    """Add one text for all options of the core that have no parameter of their own."""
    add(
        algorithm,
        QgsProcessingParameterString(OPTIONS, tr("Further options"), multiLine=True, optional=True),
        tr(
            "name=value, a line each, as on the command line; for instance threads=2, spacing_m=0.1, recursive=no, "
            "preset=paper. Or the path of a text file with such lines. docs/options.md explains all of them."
        ),
        advanced=True,
    )


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
    """Return the core's options by name from an algorithm's parameters: the quality first, named ones over it.

    Scripts may name any option of the core like a parameter, in capitals. With `every`, those that have the core's
    default are named too: needed where they replace those of an earlier run. Raises `QgsProcessingException` with
    what is wrong.
    """
    options: dict[str, Any] = {}
    if algorithm.parameterDefinition(QUALITY) is not None:
        options.update(QUALITIES[chosen_word(algorithm, parameters, context, QUALITY)])
    named: dict[str, Any] = {}
    for _, item in iterate_options():
        definition = algorithm.parameterDefinition(item.name.upper())
        if item.name in ("crs", "boundary"):
            continue
        if definition is None:
            if takes_further(algorithm) and parameters.get(item.name.upper()) not in (None, ""):
                named[item.name] = parameters[item.name.upper()]
            continue
        value = _value(algorithm, definition, parameters, context)
        if value is None or value == AS_BEFORE:
            continue
        given = parameters.get(definition.name()) is not None and item.name != "quality"
        if value != item.default or every or given:
            named[item.name] = value
    crs = target_crs(algorithm, parameters, context)
    if crs:
        named["crs"] = crs
    try:
        further = (
            read_options(algorithm.parameterAsString(parameters, OPTIONS, context)) if takes_further(algorithm) else {}
        )
        for name in further:
            own = parameters.get(name.upper()) not in (None, "") and name != "quality"
            if own and further[name] != named.get(name):
                raise OptionError(
                    f"{name} is named among the further options and as a parameter of its own: name it once"
                )
        options.update(named)
        options.update(further)
        Options.from_flat({name: value for name, value in options.items() if value is not None})
    except OptionError as error:
        raise QgsProcessingException(str(error)) from error
    for name in FILES:
        if options.get(name.lower()) and not Path(options[name.lower()]).is_file():
            title = algorithm.parameterDefinition(name)
            raise QgsProcessingException(
                tr("{}: {} does not exist, or is no file.").format(
                    title.description() if title else name.lower(), options[name.lower()]
                )
            )
    if every:
        return options
    defaults = {item.name: item.default for _, item in iterate_options()}
    if options.get("preset", "default") != "default":
        return options
    return {name: value for name, value in options.items() if name == "preset" or value != defaults[name]}


def takes_further(algorithm: QgsProcessingAlgorithm) -> bool:
    """Return whether an algorithm takes all options of the core."""
    return algorithm.parameterDefinition(OPTIONS) is not None


def target_crs(
    algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> str | None:
    """Return the CRS that was named, as PROJ reads it; raises `QgsProcessingException` where it will not do."""
    if algorithm.parameterDefinition(CRS) is None:
        return None
    crs, given = algorithm.parameterAsCrs(parameters, CRS, context), parameters.get(CRS)
    if not crs.isValid() and isinstance(given, str) and given.strip():
        raise QgsProcessingException(
            tr("{} is no coordinate reference system that QGIS knows: write it as in EPSG:32633.").format(given)
        )
    return crs_text(crs)


def _value(algorithm, definition, parameters, context) -> Any:
    name = definition.name()
    if isinstance(definition, QgsProcessingParameterBoolean):
        return algorithm.parameterAsBoolean(parameters, name, context)
    if isinstance(definition, QgsProcessingParameterEnum):
        return chosen_word(algorithm, parameters, context, name)
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
    if QgsUnitTypes.encodeUnit(crs.mapUnits()) != "meters":
        raise QgsProcessingException(
            tr("{} is in {}: choose a projected CRS in metres, or leave it empty for the UTM zone.").format(
                crs.authid() or crs.description(), QgsUnitTypes.toString(crs.mapUnits())
            )
        )
    return crs.authid() if not crs.authid().startswith("USER:") and crs.authid() else crs.toWkt()


def require_folder(path: str, what: str) -> Path:
    """Return the folder; raises `QgsProcessingException` when it is none."""
    if not path:
        raise QgsProcessingException(tr("{}: no folder is named.").format(what))
    folder = Path(path)
    if folder.is_file():
        raise QgsProcessingException(tr("{}: {} is a file; name the folder that it is in.").format(what, path))
    if not folder.is_dir():
        raise QgsProcessingException(tr("{}: {} is no folder.").format(what, path))
    return folder


def require_file(path: str, what: str) -> Path:
    """Return the file; raises `QgsProcessingException` when it is none."""
    if not Path(path).is_file():
        found = tr("is a folder; name a file") if Path(path).is_dir() else tr("does not exist")
        raise QgsProcessingException(f"{what}: {path} {found}.")
    return Path(path)
