"""QGIS with the plugin as the packager makes it, an interpreter for the core, and photographs to run on."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
NAME = "onthefly3r_qgis"
QGIS_PROCESS = shutil.which("qgis_process.bin") or shutil.which("qgis_process") or "qgis_process"
RENDERED = {"images": 12, "strips": 3, "image_width_px": 640, "image_height_px": 480}

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path[:0] = [str(ROOT / "tests" / "qgis"), str(ROOT / "tools")]


@pytest.fixture(scope="session")
def core_python() -> str:
    """The interpreter that has the core's packages."""
    named = os.environ.get("ONTHEFLY3R_PYTHON") or str(ROOT / ".venv" / "bin" / "python")
    assert Path(named).is_file(), f"{named} is missing: run python3 bootstrap.py test, or set ONTHEFLY3R_PYTHON"
    return named


@pytest.fixture(scope="session")
def plugin_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip of the plugin."""
    from package_plugin import package

    return package(tmp_path_factory.mktemp("zip") / "plugin.zip")


@pytest.fixture(scope="session")
def profiles(plugin_zip: Path) -> Iterator[Path]:
    """A folder of QGIS profiles, whose default one has the plugin installed and switched on."""
    with tempfile.TemporaryDirectory(prefix="profil ü ") as folder:
        profile = Path(folder) / "profiles" / "default"
        with zipfile.ZipFile(plugin_zip) as archive:
            archive.extractall(profile / "python" / "plugins")
        settings = profile / "QGIS" / "QGIS3.ini"
        settings.parent.mkdir(parents=True)
        settings.write_text(f"[PythonPlugins]\n{NAME}=true\nprocessing=true\n", encoding="utf-8")
        yield Path(folder)


@pytest.fixture(scope="session")
def qgis_environ(profiles: Path, core_python: str) -> dict[str, str]:
    """Variables for a QGIS of its own: no settings of the user, the plugin, the core's interpreter."""
    runtime = profiles / "runtime"
    runtime.mkdir(mode=0o700, exist_ok=True)
    kept = {name: value for name, value in os.environ.items() if name in ("LANG", "LC_ALL", "TMPDIR")}
    return {
        **kept,
        # The Python inside QGIS looks for its modules beside the first python3 of the path: it must be the system's.
        "PATH": os.pathsep.join(["/usr/bin", "/bin", os.environ.get("PATH", "")]),
        "HOME": str(profiles),
        "XDG_RUNTIME_DIR": str(runtime),
        "QGIS_CUSTOM_CONFIG_PATH": str(profiles),
        "QT_QPA_PLATFORM": "offscreen",
        "ONTHEFLY3R_PYTHON": core_python,
        "OMP_NUM_THREADS": "1",
    }


@pytest.fixture(scope="session")
def qgis_process(qgis_environ: dict[str, str]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run qgis_process with words; `environ` replaces variables."""

    def run(*words: str, environ: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [QGIS_PROCESS, *words],
            env={**qgis_environ, **(environ or {})},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=240,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def modules_before_plugin() -> set[str]:
    """The modules that were loaded when QGIS had started and the plugin had not; filled by the fixture `qgis`."""
    return set()


@pytest.fixture(scope="session")
def qgis(profiles: Path, core_python: str, modules_before_plugin: set[str]) -> Iterator[ModuleType]:
    """A running QGIS without a window, with Processing and the plugin; gives the module `processing`."""
    os.environ["QGIS_CUSTOM_CONFIG_PATH"] = str(profiles)
    os.environ["ONTHEFLY3R_PYTHON"] = core_python
    from qgis.core import QgsApplication
    from qgis.PyQt.QtCore import QSettings

    # Before the application: it would read the settings of whoever runs the tests.
    QSettings.setDefaultFormat(QSettings.Format.IniFormat)
    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(profiles / "settings"))
    application = QgsApplication([], True, str(profiles / "profiles" / "default"))
    application.setOrganizationName("onthefly3r-tests")
    application.initQgis()
    sys.path.insert(0, str(Path(application.pkgDataPath()) / "python" / "plugins"))
    import processing
    import qgis.utils
    from processing.core.Processing import Processing

    Processing.initialize()
    modules_before_plugin |= set(sys.modules)
    plugins = profiles / "profiles" / "default" / "python" / "plugins"
    sys.path.insert(0, str(plugins))
    qgis.utils.plugin_paths = [str(plugins)]
    qgis.utils.updateAvailablePlugins()
    assert qgis.utils.loadPlugin(NAME), "QGIS does not load the plugin"
    assert qgis.utils.startProcessingPlugin(NAME), "QGIS does not start the plugin"
    yield processing
    qgis.utils.unloadPlugin(NAME)
    application.exitQgis()


@pytest.fixture
def project(qgis: ModuleType) -> Iterator[Any]:
    """The project, empty before and after."""
    from qgis.core import QgsProject

    QgsProject.instance().clear()
    yield QgsProject.instance()
    QgsProject.instance().clear()


@pytest.fixture(scope="session")
def plugin(qgis: ModuleType) -> Callable[[str], Any]:
    """Import a module of the installed plugin, for instance `plugin.worker`."""
    import importlib

    return lambda name: importlib.import_module(f"{NAME}.{name}")


@pytest.fixture(scope="session")
def survey(core_python: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered survey: photographs in photos/, the truth in truth/."""
    out = tmp_path_factory.mktemp("survey")
    words = [f"--{name.replace('_', '-')}={value}" for name, value in RENDERED.items()]
    subprocess.run(
        [core_python, "-m", "onthefly3r", "simulate", *words, str(out)],
        env={**os.environ, "PYTHONPATH": str(ROOT / "core")},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=True,
    )
    return out


@pytest.fixture(scope="session")
def run(qgis: ModuleType, survey: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Outputs of one run of the main algorithm, in a folder whose name is not plain."""
    out = tmp_path_factory.mktemp("läufe") / "Flug 1, Süd"
    parameters = {
        "PHOTOS": str(survey / "photos"),
        "QUALITY": "preview",
        "OUTPUT": str(out),
        "CAMERAS": "TEMPORARY_OUTPUT",
        "REJECTED": "TEMPORARY_OUTPUT",
        "FOOTPRINTS": "TEMPORARY_OUTPUT",
    }
    return dict(qgis.run("onthefly3r:reconstruct", parameters))


@pytest.fixture(scope="session")
def photograph_sets() -> Path:
    """Folder of real photograph sets, as for the tests of the core."""
    named = os.environ.get("ONTHEFLY3R_PHOTOGRAPHS")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if not any(folder.glob("*/photos")):
        pytest.skip(f"no real photographs in {folder}: name a folder of sets in the variable ONTHEFLY3R_PHOTOGRAPHS")
    return folder


@pytest.fixture
def feedback(qgis: ModuleType) -> Any:
    """A feedback that remembers what it was told, and by default is not cancelled."""
    from qgis.core import QgsProcessingFeedback

    class Remembering(QgsProcessingFeedback):
        def __init__(self) -> None:
            super().__init__(False)
            self.told: list[str] = []
            self.on_progress: Callable[[str], None] = lambda text: None

        def pushInfo(self, text: str) -> None:
            self.told.append(text)

        def pushWarning(self, text: str) -> None:
            self.told.append(text)

        def pushConsoleInfo(self, text: str) -> None:
            self.told.append(text)

        def reportError(self, text: str, fatalError: bool = False) -> None:
            self.told.append(text)

        def setProgressText(self, text: str) -> None:
            self.on_progress(text)

    return Remembering()
