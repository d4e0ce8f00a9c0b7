"""All products of a run, in one pass over the cloud and then one after the other."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from .catalogue import PRODUCTS, Product
from .cloudpass import cloud_tiles
from .runview import RunView


def write_products(out: Path, view: RunView) -> dict[str, Any]:
    """Write everything that is wanted but the report into `out` and return what was made, by product.

    What an earlier export left there and is not wanted now is removed, so that nothing stale lies beside the new files.

    Raises `ReconstructionError` when a cloud is wanted and has no points.
    """
    wanted = [product for product in PRODUCTS if product.wanted(view.options.export)]
    remove_products(out)
    made = _cloud_pass(out, view, [product for product in wanted if product.sink is not None])
    for product in wanted:
        if product.write is not None:
            made[product.name] = product.write(out, view, made)
    return made


def remove_products(out: Path) -> None:
    """Remove the files of an earlier result, so that none can pass for one of the next, which may fail."""
    for product in PRODUCTS:
        for name in product.files:
            (out / name).unlink(missing_ok=True)


def _cloud_pass(out: Path, view: RunView, products: list[Product]) -> dict[str, Any]:
    if not products:
        return {}
    with ExitStack() as stack:
        sinks = {p.name: stack.enter_context(p.sink(out, view)) for p in products if p.sink is not None}
        for tile in cloud_tiles(view):
            for sink in sinks.values():
                sink.add(tile)
    return {name: sink.summary for name, sink in sinks.items()}
