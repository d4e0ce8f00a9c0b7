"""The zip against the rules of the QGIS plugin repository."""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
import zipfile
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parents[2]
NAME = "onthefly3r_qgis"
REQUIRED = ("name", "qgisMinimumVersion", "description", "about", "version", "author", "email", "repository", "tracker")
FORBIDDEN = {".pyc", ".so", ".pyd", ".dll", ".dylib", ".exe", ".sh", ".bat", ".cmd", ".ps1", ".zip", ".jar", ".whl"}


@pytest.fixture(scope="module")
def archive(plugin_zip: Path) -> zipfile.ZipFile:
    return zipfile.ZipFile(plugin_zip)


@pytest.fixture(scope="module")
def metadata(archive: zipfile.ZipFile) -> configparser.SectionProxy:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(archive.read(f"{NAME}/metadata.txt").decode("utf-8"))
    return parser["general"]


def test_size_and_folder(plugin_zip: Path, archive: zipfile.ZipFile) -> None:
    assert plugin_zip.stat().st_size <= 25_000_000
    assert {PurePosixPath(name).parts[0] for name in archive.namelist()} == {NAME}
    assert archive.testzip() is None


def test_no_binaries_scripts_caches_or_hidden_files(archive: zipfile.ZipFile) -> None:
    for entry in archive.infolist():
        path = PurePosixPath(entry.filename)
        assert path.suffix not in FORBIDDEN
        assert not any(part.startswith((".", "__pycache__", "__MACOSX")) for part in path.parts)
        assert not archive.read(entry).startswith((b"#!", b"\x7fELF", b"MZ")), path
        assert entry.external_attr >> 16 == 0o100644


def test_what_must_be_inside(archive: zipfile.ZipFile) -> None:
    names = set(archive.namelist())
    for name in ("LICENSE", "metadata.txt", "__init__.py", "bootstrap.py", "pyproject.toml", "docs/qgis.md"):
        assert f"{NAME}/{name}" in names
    assert archive.read(f"{NAME}/LICENSE") == (ROOT / "LICENSE").read_bytes()
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "core" / "onthefly3r").rglob("*.py")}
    assert {f"{NAME}/{name}" for name in modules} <= names


def test_metadata(metadata: configparser.SectionProxy, archive: zipfile.ZipFile) -> None:
    assert all(metadata.get(key, "").strip() for key in REQUIRED)
    assert (metadata["qgisMinimumVersion"], metadata["qgisMaximumVersion"]) == ("3.22", "4.99")
    assert re.fullmatch(r"\d+\.\d+\.\d+", metadata["version"])
    assert metadata["hasProcessingProvider"] == "yes"
    assert f"{NAME}/{metadata['icon']}" in archive.namelist()
    assert len(metadata["description"]) < 200 and not metadata["description"].startswith("http")
    assert "plugin" not in metadata["name"].lower()
    assert metadata["license"] == "GPL-2.0-or-later"
    assert "External dependencies" in metadata["about"]
    assert "@" not in metadata["about"]
    requirements = re.search(r"dependencies = \[(.*?)\]\n", (ROOT / "pyproject.toml").read_text(), re.DOTALL)
    assert requirements
    for name in re.findall(r'"([\w-]+)', requirements.group(1)):
        assert name in metadata["about"], name


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("tracker", "https://onthefly3r.example/issues", True),
        ("repository", "https://example.org/x", True),
        ("homepage", "http://localhost:8000/", True),
        ("homepage", "somewhere", True),
        ("email", "maintainers@drones.invalid", True),
        ("email", "nobody", True),
        ("homepage", "https://surveys.org/example", False),
        ("author", "Example Surveys Ltd", False),
    ],
)
def test_publish_refuses_examples(name: str, value: str, refused: bool, tmp_path: Path) -> None:
    import package_plugin

    real = {
        "author": "A. Surveyor",
        "email": "office@surveys.org",
        "homepage": "https://surveys.org",
        "repository": "https://code.surveys.org/onthefly3r",
        "tracker": "https://code.surveys.org/onthefly3r/issues",
    }
    lines = "\n".join(f"{key} = {text}" for key, text in {**real, name: value}.items())
    (tmp_path / "publisher.cfg").write_text(f"[publisher]\n{lines}\n", encoding="utf-8")
    if refused:
        with pytest.raises(ValueError, match=f"(?s)fill in your own.*{name} = "):
            package_plugin.package(tmp_path / "plugin.zip", publish=True, root=tmp_path)
        assert not (tmp_path / "plugin.zip").exists()
        return
    made = package_plugin.package(tmp_path / "plugin.zip", publish=True, root=tmp_path)
    text = zipfile.ZipFile(made).read(f"{NAME}/metadata.txt").decode("utf-8")
    assert f"\n{name}={value}\n" in text and text.count("tracker=") == 1


def test_verb_refuses_to_publish_what_is_here() -> None:
    command = [sys.executable, str(ROOT / "bootstrap.py"), "package", "--publish"]
    ran = subprocess.run(command, capture_output=True, text=True)
    examples = re.search(r"\.example", (ROOT / "publisher.cfg").read_text(encoding="utf-8"))
    assert (ran.returncode == 1 and "fill in your own" in ran.stderr) if examples else ran.returncode == 0


def test_sources_keep_to_the_rules(archive: zipfile.ZipFile) -> None:
    sources = [name for name in archive.namelist() if name.endswith(".py")]
    assert len(sources) > 100
    for name in sources:
        tree = ast.parse(archive.read(name))
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("exec", "eval", "os.system", "os.popen", "pickle.load", "pickle.loads"), name
                assert not any(word.arg == "shell" for word in node.keywords), name
            imported = {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            imported |= {node.module or ""} if isinstance(node, ast.ImportFrom) else set()
            assert not {part.split(".")[0] for part in imported} & {"PyQt5", "PyQt6", "PySide6", "pickle"}, name


def test_what_qgis_imports_is_python_3_9(archive: zipfile.ZipFile) -> None:
    """QGIS 3.22 brings Python 3.9 on Windows and macOS."""
    core = "|".join(("__init__", "errors", "option_fields", "options", "protocol", "files/atomic", "files/las_index"))
    own = re.compile(rf"{NAME}/(__init__\.py|(plugin|processing_algorithms)/.*\.py|core/onthefly3r/({core})\.py)")
    read = [name for name in archive.namelist() if own.fullmatch(name)]
    assert len(read) > 20
    for name in read:
        tree = ast.parse(archive.read(name), feature_version=(3, 9))
        newer = [node for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "strict"]
        assert not newer, name
        first = next((node for node in tree.body if not isinstance(node, ast.Expr)), ast.Pass())
        annotated = any(isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr) for node in ast.walk(tree))
        assert not annotated or "annotations" in ast.unparse(first), name


def test_same_source_same_zip(tmp_path: Path) -> None:
    from package_plugin import package

    assert package(tmp_path / "one.zip").read_bytes() == package(tmp_path / "two.zip").read_bytes()


def test_verb_of_bootstrap(archive: zipfile.ZipFile) -> None:
    ran = subprocess.run([sys.executable, str(ROOT / "bootstrap.py"), "package"], capture_output=True, text=True)
    assert ran.returncode == 0
    with zipfile.ZipFile(ran.stdout.strip()) as made:
        assert made.namelist() == archive.namelist()
