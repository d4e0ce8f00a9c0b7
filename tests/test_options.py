"""Options: one name each, checked values, the paper's preset, and a documented table."""

from __future__ import annotations

import dataclasses
import math
import runpy
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from onthefly3r.errors import OptionError
from onthefly3r.options import PAPER_VALUES, ExportOptions, IntakeOptions, Options, iterate_options, over_earlier
from onthefly3r.simulate import SurveyOptions

ROOT = Path(__file__).resolve().parents[1]
FIELDS = [item for _, item in iterate_options()]
BOUNDED = [item for item in FIELDS if item.metadata["minimum"] is not None]


def test_names_are_unique_and_explained() -> None:
    names = [item.name for item in FIELDS]
    assert len(set(names)) == len(names)
    assert "preset" not in names
    for item in FIELDS:
        assert item.metadata["help"]
        suffixes = {"px": "px", "deg": "deg", "m": "m", "s": "s", "mm": "mm"}
        last = item.name.split("_")[-1]
        if last in suffixes:
            assert item.metadata["unit"] == suffixes[last], item.name


def test_flat_values_and_back() -> None:
    assert Options.from_flat({}) == Options()
    assert Options.from_flat(Options().to_flat()) == Options()
    changed = Options.from_flat({"seed_size": 12, "crs": "EPSG:32633", "stray_filter": False, "alpha": 20})
    assert changed.selection.seed_size == 12
    assert changed.georeference.crs == "EPSG:32633"
    assert changed.registration.alpha == 20
    assert changed.to_flat()["stray_filter"] is False
    assert Options.from_flat(changed.to_flat()) == changed


def test_paper_preset_gives_way_to_named_values() -> None:
    paper = Options.from_flat({"preset": "paper"}).to_flat()
    assert {name: paper[name] for name in PAPER_VALUES} == PAPER_VALUES
    assert Options.from_flat({"preset": "paper", "max_retries": 2}).registration.max_retries == 2


def test_defaults_keep_their_own_bounds() -> None:
    Options.from_flat({item.name: item.default for item in FIELDS})


@pytest.mark.parametrize("item", BOUNDED, ids=lambda item: item.name)
def test_minimum_is_checked(item: dataclasses.Field[object]) -> None:
    low = item.metadata["minimum"]
    below = low - 1 if isinstance(item.default, int) and not isinstance(low, float) else math.nextafter(low, -math.inf)
    with pytest.raises(OptionError, match=item.name):
        Options.from_flat({item.name: below})


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"seed_sise": 3}, "unknown option seed_sise"),
        ({"seed_size": "many"}, "seed_size"),
        ({"seed_size": 3.5}, "seed_size"),
        ({"seed_size": True}, "seed_size"),
        ({"alpha": float("nan")}, "alpha"),
        ({"recursive": None}, "recursive"),
        ({"recursive": 1}, "recursive"),
        ({"format": "ply"}, "laz, las"),
        ({"preset": "fast"}, "default, paper"),
        ({"crs": 32633}, "crs"),
    ],
)
def test_bad_values_are_named(values: dict[str, object], told: str) -> None:
    with pytest.raises(OptionError, match=told):
        Options.from_flat(values)


@given(st.integers(3, 10**6), st.floats(-1.0, 1.0))
def test_values_within_bounds_are_kept(seed_size: int, min_similarity: float) -> None:
    options = Options.from_flat({"seed_size": seed_size, "min_similarity": min_similarity})
    assert (options.selection.seed_size, options.selection.min_similarity) == (seed_size, min_similarity)


def test_table_of_options_is_current() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "make_options.py"))
    table = (ROOT / "docs" / "options.md").read_text(encoding="utf-8")
    assert table == script["page"](), "run `make docs`"
    for item in FIELDS:
        assert f"`--{item.name.replace('_', '-')}`" in table


@pytest.mark.parametrize("made", [lambda: IntakeOptions(limit=-5), lambda: SurveyOptions(images=2)])
def test_no_slice_with_a_wrong_value_can_be_made(made: Callable[[], object]) -> None:
    with pytest.raises(OptionError, match="minimum"):
        made()


def test_infinite_values_are_refused() -> None:
    with pytest.raises(OptionError, match="finite"):
        Options.from_flat({"gps_sigma_h_m": math.inf})


@pytest.mark.parametrize(
    "values",
    [
        {"crs": "EPSG:32633", "local": True},
        {"boundary": "field.geojson", "local": True},
        {"weights": "a.safetensors"},
        {"spacing_m": 0.1, "cloud": False},
        {"descriptor_weights": "a.safetensors"},
    ],
)
def test_options_without_effect_together_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(OptionError, match=next(iter(values))):
        Options.from_flat(values)


def test_a_named_value_wins_over_what_contradicts_it_in_an_earlier_run() -> None:
    earlier = {"crs": "EPSG:32633", "format": "las"}
    assert over_earlier(earlier, {"local": True}) == {"format": "las", "local": True}
    assert over_earlier({"local": True}, {"crs": "EPSG:32633"}) == {"crs": "EPSG:32633"}


def test_named_values_are_told_apart_from_defaults() -> None:
    named = {"preset": "paper", "max_retries": 3}
    assert Options.from_flat(named).to_named() == named
    assert Options(export=ExportOptions(format="las")).to_named() == {"preset": "default", "format": "las"}


def test_every_option_has_an_example() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "make_options.py"))
    for item in FIELDS:
        words = script["example"](item).strip("`").split()
        assert len(words) == 2 or isinstance(item.default, bool), item.name
