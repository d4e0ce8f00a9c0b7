"""The list of products: every file that a run writes is on it, and no name twice."""

from __future__ import annotations

from pathlib import Path

from onthefly3r.geometry.transforms import Sim3
from onthefly3r.options import ExportOptions, Options
from onthefly3r.products.catalogue import PRODUCTS, layers_in
from onthefly3r.products.exportframe import ExportFrame
from onthefly3r.products.runview import RunView
from onthefly3r.products.writing import write_products
from oracle_runs import run, survey_of

LISTED = {name for product in PRODUCTS for name in product.files}


def view_of(folder: Path, export: ExportOptions | None = None) -> RunView:
    """A small reconstructed survey in local coordinates."""
    engine = run(folder, survey_of(12, 2)).engine
    return RunView(
        title="a < survey",
        options=Options(export=export or ExportOptions()),
        state=engine.state,
        store=engine.store,
        shots=engine.shots,
        rejections=engine.rejections,
        retries=engine.retries,
        refused=(),
        reference=None,
        frame=ExportFrame(Sim3(), None, False),
        work=folder / "temporary",
        checkpoint=lambda stage, done, total: None,
    )


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_names_and_files_are_unique() -> None:
    assert len({product.name for product in PRODUCTS}) == len(PRODUCTS)
    assert sum(len(product.files) for product in PRODUCTS) == len(LISTED)


def test_everything_written_is_listed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    made = write_products(out, view_of(tmp_path / "run"))
    written = files_in(out)
    assert written
    assert written <= LISTED
    assert made["cloud"].points > 0
    layers = layers_in(out, made)
    assert {layer["path"] for layer in layers} <= written
    shown = [layer["table"] or layer["path"] for layer in layers if layer["shown"]]
    assert shown[0] == "cameras"
    assert shown[-1].startswith("cloud.")
    assert {layer["table"] for layer in layers} >= {"footprints", "coverage"}
    assert "control" not in {layer["table"] for layer in layers}


def test_what_is_not_wanted_is_not_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    made = write_products(out, view_of(tmp_path / "run", ExportOptions(cloud=False)))
    assert "cloud" not in made
    assert not {"cloud.las", "cloud.laz", "preview.png"} & files_in(out)
    assert "cameras.shp" in files_in(out)
