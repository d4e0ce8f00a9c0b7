"""What the layout promises: layers, late imports, docstrings, requirements told once."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "core" / "onthefly3r"
MODULES = sorted(PACKAGE.rglob("*.py"))
HEAVY = {"PIL", "cv2", "embreex", "gtsam", "laspy", "matplotlib", "open3d", "pycolmap", "pyproj", "rasterio"}
HEAVY |= {"pillow_heif", "rawpy", "scipy", "shapefile", "torch", "trimesh"}

# A module imports only from layers above its own; modules of one sub-package may import each other.
FOUNDATION = {"errors", "options", "option_fields", "protocol", "geometry", "stopwatch", "files"}
LAYERS = (
    FOUNDATION,
    {"records", "networks"},
    {"intake", "features"},
    {"adjust"},
    {"selection", "backbones", "registration", "evaluate"},
    {"map"},
    {"earth", "cloud"},
    {"graph"},
    {"products"},
    {"simulate", "engine"},
    {"run"},
    {"commands"},
    {"__main__"},
)


def part(path: Path) -> str:
    """The package's part that a file belongs to: a top-level module or a sub-package."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_parts(path: Path) -> set[str]:
    """Parts of the package that a file imports at run time; imports for type checkers only do not count."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    parents = path.relative_to(PACKAGE).parts[:-1]
    found = set()
    for node in ast.walk(tree):
        if id(node) in for_types or not isinstance(node, ast.ImportFrom) or node.level == 0:
            continue
        base = parents[: len(parents) - (node.level - 1)]
        target = (*base, *(node.module.split(".") if node.module else ()))
        found |= {target[0]} if target else {alias.name for alias in node.names}
    return {name for name in found if (PACKAGE / name).is_dir() or (PACKAGE / f"{name}.py").is_file()}


def rank(name: str) -> int:
    return next(index for index, layer in enumerate(LAYERS) if name in layer)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_keeps_to_its_layer(path: Path) -> None:
    own = part(path)
    if own == "__init__":
        # The package's own __init__ imports the engine, but only when an attribute is asked for.
        top = ast.parse(path.read_text(encoding="utf-8")).body
        assert not [node for node in top if isinstance(node, ast.ImportFrom) and node.level]
        return
    for other in imported_parts(path) - {own}:
        together = {own, other} <= FOUNDATION
        assert rank(other) < rank(own) or together, f"{own} imports {other}"


def imported_modules(path: Path) -> set[Path]:
    """Files of the package that a file imports when it is loaded, not when a function of it is called."""
    parents = path.relative_to(PACKAGE).parts[:-1]
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level:
            base = PACKAGE.joinpath(*parents[: len(parents) - (node.level - 1)], *(node.module or "").split("."))
            for candidate in (base.with_suffix(".py"), *(base / f"{alias.name}.py" for alias in node.names)):
                if candidate.is_file():
                    found.add(candidate)
    return found


def test_no_module_imports_itself_through_others() -> None:
    from graphlib import TopologicalSorter

    graph = {path: imported_modules(path) for path in MODULES if path.name != "__init__.py"}
    assert len(list(TopologicalSorter(graph).static_order())) >= len(graph)  # raises CycleError


def test_no_two_modules_have_the_same_name() -> None:
    names = [path.name for path in MODULES if path.name != "__init__.py"]
    assert sorted(set(names)) == sorted(names)


def test_layers_name_every_part() -> None:
    assert {part(path) for path in MODULES} - {"__init__"} <= set().union(*LAYERS)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_the_package_relatively_and_has_a_docstring(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree)
    absolute = [
        node.module if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
        for node in ast.walk(tree)
        if (isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").startswith("onthefly3r"))
        or (isinstance(node, ast.Import) and any(alias.name.startswith("onthefly3r") for alias in node.names))
    ]
    assert not absolute


def loaded_by(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after the statement."""
    script = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    ran = subprocess.run([sys.executable, "-c", script], cwd=PACKAGE.parent, capture_output=True, text=True, check=True)
    return set(ran.stdout.split())


@pytest.mark.parametrize("module", ["errors", "options", "protocol"])
def test_what_qgis_imports_is_standard_library_only(module: str) -> None:
    before = loaded_by("pass")
    extra = loaded_by(f"import onthefly3r.{module}") - before - set(sys.stdlib_module_names)
    assert extra == {"onthefly3r"}


def test_help_loads_nothing_heavy() -> None:
    show_help = "\n".join(
        [
            "import contextlib, io",
            "from onthefly3r.commands.cli import app",
            "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):",
            "    app(['run', '-h'])",
        ]
    )
    assert not loaded_by(show_help) & HEAVY


def test_importing_a_module_loads_nothing_heavy() -> None:
    names = [
        ".".join(("onthefly3r", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")
        for path in MODULES
        if path.name != "__main__.py"
    ]
    assert not loaded_by("import " + ", ".join(names)) & HEAVY


def test_doctor_knows_every_requirement() -> None:
    from onthefly3r.commands.doctor import PACKAGES

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = {(name_of(line), "") for line in project["dependencies"]}
    wanted |= {(name_of(line), extra) for extra in ("neural", "cloud", "heic", "raw") for line in extras[extra]}
    known = {(package.distribution, package.extra) for package in PACKAGES}
    assert known == {(name.removesuffix("-cpu"), extra) for name, extra in wanted}


def name_of(requirement: str) -> str:
    """The distribution of a requirement line."""
    return requirement.split(";")[0].split("[")[0].split(">")[0].split("=")[0].strip()


def test_no_module_bears_a_standard_library_name() -> None:
    assert not {path.stem for path in MODULES} & set(sys.stdlib_module_names) - {"__init__", "__main__"}


def test_method_page_names_modules_that_exist() -> None:
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/]+\.py)`", page))
    assert len(named) > 20
    assert not {name for name in named if not (PACKAGE / name).is_file()}
