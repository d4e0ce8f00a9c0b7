"""Processing parameters from the core's option declarations, so that no option is written twice."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from qgis.core import (
    Qgis,
    QgsCoordinateReferenceSystem,
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

from ..core.onthefly3r.options import iterate_options
from .base import tr

# Names of the parameters that are not options of the core.
QUALITY, CRS = "QUALITY", "CRS"

# The presets set these; whoever names one of them in the advanced parameters overrides the preset.
QUALITIES: dict[str, dict[str, int]] = {
    "preview": {"working_px": 600, "dense_px": 250, "features": 2000},
    "standard": {},
    "full": {"working_px": 1600, "dense_px": 1000, "features": 8000},
}
# With parameters of their own, or of no use in QGIS.
NOT_SHOWN = {"crs", "boundary", "backbone", "vertical", "positions"}
BACKBONES = ("classical", "da3", "pi3", "pi3x", "vggt", "vggt-omega", "mapanything")


def add(algorithm: QgsProcessingAlgorithm, parameter: QgsProcessingParameterDefinition, help: str, advanced=False):
    """Add a parameter with its help."""
    parameter.setHelp(help)
    if advanced:
        parameter.setFlags(parameter.flags() | advanced_flag())
    algorithm.addParameter(parameter)


def advanced_flag():
    """Return the flag of advanced parameters, which moved in QGIS 3.36."""
    if hasattr(Qgis, "ProcessingParameterFlag"):
        return Qgis.ProcessingParameterFlag.Advanced
    return QgsProcessingParameterDefinition.FlagAdvanced


def number_type(integer: bool):
    """Return the type of number parameters, which moved in QGIS 3.36."""
    if hasattr(Qgis, "ProcessingNumberParameterType"):
        types = Qgis.ProcessingNumberParameterType
        return types.Integer if integer else types.Double
    return QgsProcessingParameterNumber.Integer if integer else QgsProcessingParameterNumber.Double


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


def add_crs(algorithm: QgsProcessingAlgorithm) -> None:
    """Add the target CRS and the height reference."""
    add(
        algorithm,
        QgsProcessingParameterCrs(CRS, tr("Coordinate reference system"), optional=True),
        tr("Projected, in metres. Left empty, the UTM zone of the photographs' median position is taken."),
    )
    item = next(item for _, item in iterate_options() if item.name == "vertical")
    add(
        algorithm,
        words_parameter("VERTICAL", tr("Height reference"), item.metadata["choices"], "auto"),
        tr(
            "What the heights in the photographs refer to; the results keep it. auto decides from the tags and says "
            "so in the report. ellipsoidal: above WGS 84. egm96, egm2008: above mean sea level (geoid)."
        ),
    )


def add_options(algorithm: QgsProcessingAlgorithm, slices: Iterable[str] | None = None) -> None:
    """Add the core's options of some slices (default: all) as advanced parameters; empty means the core's default."""
    wanted = None if slices is None else set(slices)
    for slice_name, item in iterate_options():
        if item.name not in NOT_SHOWN and (wanted is None or slice_name in wanted):
            add(algorithm, option_parameter(item), option_help(item), advanced=True)


def option_parameter(item: dataclasses.Field) -> QgsProcessingParameterDefinition:
    """Return the parameter of one option, named like it in capitals."""
    facts, name, kind = item.metadata, item.name.upper(), str(item.type)
    title = tr(item.name.replace("_", " "))
    if facts["unit"]:
        title += f" [{facts['unit']}]"
    if facts["choices"]:
        return words_parameter(name, title, facts["choices"], item.default)
    if kind == "bool":
        return QgsProcessingParameterBoolean(name, title, defaultValue=item.default)
    if kind.startswith(("int", "float")):
        parameter = QgsProcessingParameterNumber(name, title, number_type(kind.startswith("int")), optional=True)
        if facts["minimum"] is not None:
            parameter.setMinimum(facts["minimum"])
        if facts["maximum"] is not None:
            parameter.setMaximum(facts["maximum"])
        # Empty instead of the default, so that the quality preset can tell what the user named.
        parameter.setDefaultValue(None)
        return parameter
    return QgsProcessingParameterString(name, title, optional=True)


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
    algorithm: QgsProcessingAlgorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> dict[str, Any]:
    """Return the core's options by name from an algorithm's parameters: the preset first, named ones over it."""
    options: dict[str, Any] = {}
    if algorithm.parameterDefinition(QUALITY) is not None:
        options.update(QUALITIES[algorithm.parameterAsEnumString(parameters, QUALITY, context)])
    for _, item in iterate_options():
        definition = algorithm.parameterDefinition(item.name.upper())
        if definition is None or item.name == "crs":
            continue
        value = _value(algorithm, definition, parameters, context)
        if value is not None and value != item.default:
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
        if definition.dataType() == number_type(integer=True):
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
