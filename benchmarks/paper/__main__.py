"""Commands: `python -m benchmarks.paper simulated | photographs | dataset | compare`; `-h` after each explains it."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from onthefly3r.errors import InputError

from . import photographs, simulated
from .datasets import OUTDOOR, SCENES, SEVEN_SCENES, read_scene
from .measured import OURS, measure_all
from .photograph_table import photographs_table
from .run_scene import run_scene
from .simulated_tables import ablation_table, strategies_table
from .strategies import STRATEGIES
from .tables import geometry_table, macro_table, per_scene_table, seven_scenes_table

PACKAGES = ("onthefly3r", "numpy", "scipy", "gtsam", "pycolmap", "embreex")
SURVEYS = ("joint", "HAV-in-order", "HAV", "Residence", "Campus")
SETS = ("brighton_beach", "caliterra", "sheffield_cross")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 2 when the input is wrong."""
    chosen = _parser().parse_args(arguments)
    try:
        chosen.command(chosen)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def versions() -> str:
    """Return machine and packages for below a table."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    packages = ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES)
    return f"{platform.system()} {platform.machine()}, {cores} cores, Python {platform.python_version()}; {packages}"


def _simulated(chosen: argparse.Namespace) -> None:
    if not chosen.table_only:
        simulated.run_all(chosen.scenario, chosen.strategy, chosen.seed, chosen.out)
    rows = simulated.read_rows(chosen.out)
    for scenario in chosen.scenario:
        print(f"\n### {scenario}\n\n{strategies_table(rows, chosen.out, scenario)}")
        if any(row["strategy"].startswith("case-") and row["scenario"] == scenario for row in rows):
            print(f"\nAblation:\n\n{ablation_table(rows, scenario)}")
    print(f"\n{versions()}")


def _photographs(chosen: argparse.Namespace) -> None:
    folders = [chosen.sets / name for name in chosen.set]
    missing = [folder for folder in folders if not ((folder / "photos").is_dir() and (folder / "reference").is_dir())]
    if missing:
        raise InputError(f"{missing[0]}: holds no photos/ and reference/; name the folder of sets with --sets")
    if not chosen.table_only:
        photographs.run_all(folders, chosen.order, chosen.strategy, chosen.seed, chosen.out, chosen.option)
    print(f"\n{photographs_table(simulated.read_rows(chosen.out))}\n\n{versions()}")


def _dataset(chosen: argparse.Namespace) -> None:
    for name in chosen.scene:
        result = run_scene(read_scene(name, chosen.root), chosen.out / chosen.method, chosen.option)
        errors = result.errors
        ate = "-" if errors is None else f"{errors.ate:.3f} m"
        print(f"{name}: ATE {ate}, {result.placed} of {result.given} placed", flush=True)


def _compare(chosen: argparse.Namespace) -> None:
    roots = {
        **dict.fromkeys(SCENES[:4], chosen.gauu_scene),
        **dict.fromkeys(OUTDOOR[4:], chosen.urban_scene),
        **dict.fromkeys(SEVEN_SCENES, chosen.seven_scenes),
    }
    scenes = {name: read_scene(name, root) for name, root in roots.items() if root is not None}
    if not scenes:
        raise InputError("name at least one data set: --gauu-scene, --urban-scene or --seven-scenes")
    results = measure_all(chosen.results, scenes, chosen.common)
    if set(scenes) & set(OUTDOOR):
        print(f"### ATE (m) and coverage, all returned poses\n\n{per_scene_table(results)}\n")
        print(f"### Means over six scenes, frames accepted by {chosen.common}\n\n{macro_table(results)}\n")
        print(f"### Clouds, time, memory\n\n{geometry_table(results)}\n")
    if set(scenes) & set(SEVEN_SCENES):
        print(f"### 7-Scenes, ATE (cm)\n\n{seven_scenes_table(results)}\n")
    print("In brackets: the paper's number.")


def _option(text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    try:
        return name.replace("-", "_"), json.loads(value)
    except ValueError:
        return name.replace("-", "_"), value


class _Options(argparse.Action):
    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        setattr(namespace, self.dest, dict(values))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("simulated", help="all strategies with the oracle on simulated surveys")
    command.set_defaults(command=_simulated)
    command.add_argument(
        "--scenario",
        nargs="+",
        choices=simulated.SCENARIOS,
        default=list(SURVEYS),
    )
    command.add_argument("--seed", nargs="+", type=int, default=[0, 1, 2])
    _common(command, Path("evidence-simulated"))

    command = commands.add_parser("photographs", help="all strategies with a real backbone on real photographs")
    command.set_defaults(command=_photographs)
    named = os.environ.get("ONTHEFLY3R_PHOTOGRAPHS")
    command.add_argument("--sets", type=Path, default=Path(named) if named else None, required=named is None)
    command.add_argument("--set", nargs="+", default=list(SETS), help="sub-folders with photos/ and reference/")
    command.add_argument("--order", nargs="+", choices=photographs.ORDERS, default=list(photographs.ORDERS))
    command.add_argument("--seed", type=int, default=0, help="of the shuffled order")
    _common(command, Path("evidence-photographs"))
    _engine_options(command)

    command = commands.add_parser("dataset", help="our run on scenes of the paper's data sets")
    command.set_defaults(command=_dataset)
    command.add_argument("root", type=Path, help="root of GauU-Scene V2, UrbanScene3D or 7-Scenes")
    command.add_argument("--scene", nargs="+", choices=SCENES, required=True)
    command.add_argument("--out", type=Path, default=Path("evidence-results"), help="results of all methods")
    command.add_argument("--method", default=OURS, help="folder of this run in it")
    _engine_options(command)

    command = commands.add_parser("compare", help="the paper's tables from the results of any programs")
    command.set_defaults(command=_compare)
    command.add_argument("results", type=Path, help="folder with METHOD/SCENE.npz, .txt (TUM) or COLMAP folders")
    command.add_argument("--gauu-scene", type=Path, help="root of GauU-Scene V2")
    command.add_argument("--urban-scene", type=Path, help="root of UrbanScene3D")
    command.add_argument("--seven-scenes", type=Path, help="root of 7-Scenes")
    command.add_argument("--common", default=OURS, help="method whose accepted frames are the common set")
    return parser


def _common(command: argparse.ArgumentParser, out: Path) -> None:
    command.add_argument("--strategy", nargs="+", choices=STRATEGIES, default=list(STRATEGIES))
    command.add_argument("--out", type=Path, default=out, help="figures and poses; what is there is not run again")
    command.add_argument("--table-only", action="store_true", help="run nothing, print the table of what is there")


def _engine_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--option", nargs="+", type=_option, action=_Options, default={}, metavar="NAME=VALUE", help="engine options"
    )


if __name__ == "__main__":
    raise SystemExit(main())
