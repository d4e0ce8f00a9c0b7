"""What PyQt 6 takes away, looked for in the source: QGIS 4 has no enumeration member outside its enumeration.

Names are looked up in the classes of the QGIS at hand, so that every class and enumeration is known.
"""

from __future__ import annotations

import ast
import enum
import importlib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(
    [*(ROOT / "plugin").glob("*.py"), *(ROOT / "processing_algorithms").glob("*.py"), ROOT / "__init__.py"]
)
GONE = {"exec_", "print_", "toPyObject", "setMargin", "QRegExp", "QDesktopWidget", "QTextCodec"}
# Modules that PyQt 6, or QGIS 4's `qgis.PyQt`, does not have.
NO_MODULES = {"qgis.PyQt.QtWebKit", "qgis.PyQt.QtWebKitWidgets", "qgis.PyQt.QtXmlPatterns"}


def faults(source: str) -> list[str]:
    """Return what PyQt 6 would not take, with its line."""
    tree = ast.parse(source)
    classes: dict[str, Any] = {}
    found = []
    guarded = {id(inner) for node in ast.walk(tree) if isinstance(node, ast.Try) for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("qgis"):
            if node.module in NO_MODULES and id(node) not in guarded:
                found.append(f"{node.lineno}: {node.module}")
            for alias in node.names:
                try:
                    classes[alias.asname or alias.name] = getattr(
                        importlib.import_module(node.module or ""), alias.name
                    )
                except (ImportError, AttributeError):
                    continue  # of another version, guarded by the test of imports
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            found += [f"{node.lineno}: {name}" for name in names if name.split(".")[0] in ("PyQt5", "PyQt6")]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Attribute):
            continue
        if node.attr in GONE:
            found.append(f"{node.lineno}: {node.attr}")
        if isinstance(node.value, ast.Name) and isinstance(classes.get(node.value.id), type):
            owner = classes[node.value.id]
            value = getattr(owner, node.attr, None)
            is_member = isinstance(value, (int, enum.Enum)) and type(value) not in (int, bool)
            if is_member and not isinstance(owner, enum.EnumMeta) and type(value) is not owner:
                found.append(f"{node.lineno}: {node.value.id}.{node.attr}")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=[path.relative_to(ROOT).as_posix() for path in SOURCES])
def test_sources_keep_to_pyqt_6(qgis: Any, path: Path) -> None:
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("source", "wrong"),
    [
        ("from qgis.core import QgsWkbTypes\nQgsWkbTypes.PointZ", True),
        ("from qgis.core import QgsWkbTypes\nQgsWkbTypes.Type.PointZ", False),
        ("from qgis.core import QgsProcessing as P\nP.TypeVectorPoint", True),
        ("from qgis.PyQt.QtCore import Qt\nQt.AlignLeft", True),
        ("from qgis.PyQt.QtCore import Qt\nQt.AlignmentFlag.AlignLeft", False),
        ("from qgis.PyQt.QtCore import QVariant\nQVariant.String", True),
        ("from qgis.PyQt.QtWidgets import QDialog\nQDialog().exec_()", True),
        ("from qgis.PyQt.QtWidgets import QDialog\nQDialog().exec()", False),
        ("from PyQt5.QtCore import Qt", True),
        ("from qgis.PyQt.QtWebKitWidgets import QWebView", True),
        ("from qgis.core import Qgis\nQgis.QGIS_VERSION_INT", False),
    ],
)
def test_the_check_finds_them(qgis: Any, source: str, wrong: bool) -> None:
    assert bool(faults(source)) == wrong
