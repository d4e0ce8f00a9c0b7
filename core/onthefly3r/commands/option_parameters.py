"""Command-line parameters built from option dataclasses, so that no option is written twice."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_args, get_type_hints

import typer

from ..options import Options, Preset, slice_classes

ADVANCED_PANEL = "Advanced"
# The switches have long names in two forms: in a panel of their own they leave the others room at 80 columns.
SWITCHES_PANEL = "Advanced, on or off"


def with_run_options(*slices: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of the named slices of `Options`, or of all of them and the preset."""
    parameters = []
    if not slices:
        choices = ", ".join(get_args(Preset))
        help_text = f"whose defaults are taken; paper does what the paper does (one of {choices}; default: default)"
        parameters.append(_parameter("preset", Preset, help_text, "", panel="Options"))
    for name, options_class in slice_classes().items():
        if not slices or name in slices:
            parameters += option_parameters(options_class, name.replace("_", " ").capitalize())
    return _with_parameters(parameters)


def with_options_of(options_class: type, panel: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of one dataclass whose fields are declared with `options.option`."""
    return _with_parameters(option_parameters(options_class, panel))


def option_parameters(options_class: type, panel: str) -> list[inspect.Parameter]:
    """Return one keyword parameter per field, None when the user did not name it; advanced ones in own panels."""
    hints = get_type_hints(options_class)
    parameters = []
    for item in dataclasses.fields(options_class):
        if "help" not in item.metadata:
            continue
        advanced_panel = SWITCHES_PANEL if hints[item.name] is bool else ADVANCED_PANEL
        place = advanced_panel if item.metadata["advanced"] else panel
        parameters.append(_parameter(item.name, hints[item.name], describe(item), item.metadata["unit"], place))
    return parameters


def describe(item: dataclasses.Field[Any]) -> str:
    """Return an option's help with its choices, default, unit and bounds."""
    unit = f" {item.metadata['unit']}" if item.metadata["unit"] else ""
    low, high = item.metadata["minimum"], item.metadata["maximum"]
    facts = []
    if item.metadata["choices"]:
        facts.append(f"one of {', '.join(item.metadata['choices'])}")
    if isinstance(item.default, bool):
        facts.append(f"default: {'on' if item.default else 'off'}")
    elif item.default is not None:
        facts.append(f"default: {item.default}{unit}")
    elif unit:
        facts.append(f"in{unit}")
    if item.metadata["example"]:
        facts.append(f"example: {item.metadata['example']}{unit}")
    if low is not None and high is not None:
        facts.append(f"{low} to {high}")
    elif low is not None:
        facts.append(f"at least {low}")
    elif high is not None:
        facts.append(f"at most {high}")
    return str(item.metadata["help"]) + (f" ({'; '.join(facts)})" if facts else "")


def run_options(values: Mapping[str, Any]) -> Options:
    """Build the options from a command's keyword values; raises `OptionError`."""
    return Options.from_flat(given(values))


def given(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that the user named."""
    return {name: value for name, value in values.items() if value is not None}


def _parameter(name: str, hint: Any, help_text: str, unit: str, panel: str) -> inspect.Parameter:
    flag = "--" + name.replace("_", "-")
    value_type: Any = next((part for part in get_args(hint) if isinstance(part, type) and part is not type(None)), hint)
    if value_type is bool:
        flag += "/--no-" + name.replace("_", "-")
    # A short word beside the name keeps the help readable at 80 columns; choices stand in the help text.
    word = unit.replace(" ", "-") or {int: "number", float: "number", bool: ""}.get(value_type, "word")
    info = typer.Option(flag, help=help_text, metavar=word, show_default=False, rich_help_panel=panel)
    annotation = Annotated[value_type | None, info]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _with_parameters(added: list[inspect.Parameter]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    def panel_rank(parameter: inspect.Parameter) -> int:
        panel = parameter.annotation.__metadata__[0].rich_help_panel
        return (ADVANCED_PANEL, SWITCHES_PANEL).index(panel) + 1 if panel in (ADVANCED_PANEL, SWITCHES_PANEL) else 0

    added = sorted(added, key=panel_rank)

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = [p for p in inspect.signature(command, eval_str=True).parameters.values() if p.kind is not p.VAR_KEYWORD]

        @functools.wraps(command)
        def wrapper(**values: Any) -> None:
            command(**values)

        # typer reads both; functools.wraps left it the command's own, which lack the added options.
        wrapper.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
        wrapper.__annotations__ = {p.name: p.annotation for p in (*own, *added)}
        del wrapper.__wrapped__
        return wrapper

    return decorate
