"""All products of a run, in one pass over the cloud and then one after the other."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from .catalogue import PRODUCTS, Product
from .cloudpass import gathered
from .runview import RunView


def write_products(out: Path, view: RunView) -> dict[str, Any]:
    """Write everything that is wanted but the report into `out`, an empty folder; return what was made, by product.

    `far_points` is how many points were left out because they lie far outside the survey.

    Raises `ReconstructionError` when a cloud is wanted and has no points.
    """
    wanted = [product for product in PRODUCTS if product.wanted(view.options.export)]
    made = _cloud_pass(out, view, [product for product in wanted if product.sink is not None])
    for product in wanted:
        if product.write is not None:
            made[product.name] = product.write(out, view, made)
    return made


def _cloud_pass(out: Path, view: RunView, products: list[Product]) -> dict[str, Any]:
    if not products:
        return {}
    with ExitStack() as stack:
        cloud, tiles = stack.enter_context(gathered(view))
        sinks = {p.name: stack.enter_context(p.sink(out, view, cloud)) for p in products if p.sink is not None}
        for done, tile in enumerate(tiles):
            view.checkpoint("writing the cloud", done, cloud.tiles)
            for sink in sinks.values():
                sink.add(tile)
    return {"far_points": cloud.left_out, **{name: sink.summary for name, sink in sinks.items()}}
