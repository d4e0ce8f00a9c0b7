"""Pictures of the QGIS desktop with the plugin, for docs/qgis.md and as a test that the desktop starts with it.

    python3 tools/qgis_pictures.py PROFILES PHOTOGRAPHS OUT     needs qgis and Xvfb; variable ONTHEFLY3R_PYTHON

PROFILES is a folder of QGIS profiles in whose default one the plugin is installed. QGIS itself runs this file again,
inside; that part draws the windows into PNG files. Standard library only outside.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import traceback
from pathlib import Path

PHOTOGRAPHS, OUT = "ONTHEFLY3R_PICTURES_OF", "ONTHEFLY3R_PICTURES"
LIMIT_S = 400
SCREEN = "1400x900x24"
START_MS, SETTLE_MS = 2500, 1200


# ---------------------------------------------------------------------- outside


def take_pictures(profiles: Path, photographs: Path, out: Path, environ: dict[str, str]) -> list[Path]:
    """Start the desktop under a virtual screen, return the pictures; raises `RuntimeError` with what QGIS said."""
    out.mkdir(parents=True, exist_ok=True)
    with virtual_screen() as display:
        ran = subprocess.run(
            [program("qgis"), "--nologo", "--noversioncheck", "--profiles-path", str(profiles), "--code", __file__],
            env={
                **environ,
                "DISPLAY": display,
                "QT_QPA_PLATFORM": "xcb",
                PHOTOGRAPHS: str(photographs),
                OUT: str(out),
            },
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=LIMIT_S,
            check=False,
        )
    failure = out / "failure.txt"
    if failure.is_file():
        raise RuntimeError(failure.read_text(encoding="utf-8"))
    pictures = sorted(out.glob("qgis-*.png"))
    if not pictures:
        raise RuntimeError(f"QGIS ended with status {ran.returncode} and no picture:\n{ran.stderr[-3000:]}")
    return pictures


def program(name: str) -> str:
    """Return the path of a program; raises `RuntimeError` when it is not installed."""
    found = shutil.which(name)
    if found is None:
        raise RuntimeError(f"{name} is not installed")
    return found


@contextlib.contextmanager
def virtual_screen():
    """Yield the name of a display of its own."""
    read, write = os.pipe()
    server = subprocess.Popen(
        [program("Xvfb"), "-displayfd", str(write), "-screen", "0", SCREEN, "-nolisten", "tcp"],
        pass_fds=[write],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as told:
            number = told.readline().strip()
        if not number:
            raise RuntimeError("Xvfb did not start")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


# ---------------------------------------------------------------------- inside QGIS


class Pictures:
    """The steps, one after the other, while the desktop's event loop runs."""

    def __init__(self) -> None:
        self.photographs, self.out = Path(os.environ[PHOTOGRAPHS]), Path(os.environ[OUT])
        self.work = self.out / "work"
        self.steps = [
            self.toolbox,
            self.dialog,
            self.all_dialogs,
            self.check,
            self.checked_map,
            self.run,
            self.result_map,
            self.report,
        ]

    def start(self) -> None:
        """Begin when the desktop has come up."""
        self._later(START_MS, self._next)

    def _next(self) -> None:
        try:
            if self.steps:
                self.steps.pop(0)()
                self._later(SETTLE_MS, self._next)
                return
        except Exception:
            (self.out / "failure.txt").write_text(traceback.format_exc(), encoding="utf-8")
        shutil.rmtree(self.work, ignore_errors=True)
        os._exit(0)  # the desktop would ask whether to save the project

    def _later(self, after_ms: int, then) -> None:
        from qgis.PyQt.QtCore import QTimer

        QTimer.singleShot(after_ms, then)

    def toolbox(self) -> None:
        """The toolbox with the provider's group open."""
        from qgis.PyQt.QtWidgets import QDockWidget, QTreeView
        from qgis.utils import iface

        window = iface.mainWindow()
        window.resize(1200, 760)
        for dock in window.findChildren(QDockWidget):
            dock.setVisible(dock.objectName() in ("ProcessingToolbox", "Layers"))
        iface.newProject()
        toolbox = window.findChild(QDockWidget, "ProcessingToolbox")
        tree = toolbox.findChild(QTreeView)
        tree.collapseAll()
        for row in range(tree.model().rowCount()):
            index = tree.model().index(row, 0)
            if "On-the-Fly3R" in str(index.data()):
                tree.expand(index)
        tree.scrollToBottom()
        self._later(SETTLE_MS // 2, lambda: self._save(toolbox, "qgis-toolbox.png"))

    def dialog(self) -> None:
        """The dialog of the main algorithm."""
        import processing

        values = {"PHOTOS": "/surveys/2026-05-14 quarry/photos", "OUTPUT": "/surveys/2026-05-14 quarry/result"}
        dialog = processing.createAlgorithmDialog("onthefly3r:reconstruct", values)
        dialog.resize(1000, 700)
        dialog.show()
        self._dialog = dialog
        self._later(SETTLE_MS // 2, lambda: self._save(dialog, "qgis-reconstruct.png"))

    def all_dialogs(self) -> None:
        """Every algorithm can be opened, for one run and as a batch."""
        import processing
        from processing.gui.BatchAlgorithmDialog import BatchAlgorithmDialog
        from qgis.core import QgsApplication
        from qgis.utils import iface

        self._dialog.close()
        for algorithm in QgsApplication.processingRegistry().providerById("onthefly3r").algorithms():
            dialog = processing.createAlgorithmDialog(algorithm.id(), {})
            batch = BatchAlgorithmDialog(algorithm.create(), iface.mainWindow())
            for opened in (dialog, batch):
                opened.show()
                opened.close()
                opened.deleteLater()

    def check(self) -> None:
        """Photographs looked at before."""
        import processing

        processing.runAndLoadResults(
            "onthefly3r:check",
            {"PHOTOS": str(self.photographs), "CHECKED": self._layer(), "FOOTPRINTS": self._layer()},
        )
        self._whole_map()

    def checked_map(self) -> None:
        """Their map."""
        self._save_window("qgis-check.png")

    def run(self) -> None:
        """The main algorithm."""
        import processing
        from qgis.core import QgsProject

        QgsProject.instance().clear()
        parameters = {
            "PHOTOS": str(self.photographs),
            "QUALITY": "preview",
            "OUTPUT": str(self.work / "quarry"),
        }
        processing.runAndLoadResults("onthefly3r:reconstruct", parameters)
        self._whole_map()

    def result_map(self) -> None:
        """Cameras over the ground."""
        self._save_window("qgis-result.png")

    def report(self) -> None:
        """The page of the run."""
        from qgis.PyQt.QtCore import QUrl
        from qgis.PyQt.QtWebKitWidgets import QWebView

        self._page = QWebView()
        self._page.resize(760, 1180)
        self._page.setZoomFactor(0.75)
        self._page.load(QUrl.fromLocalFile(str(self.work / "quarry" / "report.html")))
        self._page.show()
        self._later(SETTLE_MS // 2, lambda: self._save(self._page, "qgis-report.png"))

    def _layer(self):
        from qgis.core import QgsProcessingOutputLayerDefinition, QgsProject

        return QgsProcessingOutputLayerDefinition("TEMPORARY_OUTPUT", QgsProject.instance())

    def _whole_map(self) -> None:
        from qgis.utils import iface

        iface.layerTreeView().expandAll()
        canvas = iface.mapCanvas()
        canvas.zoomToFullExtent()
        canvas.zoomByFactor(1.1)

    def _save_window(self, name: str) -> None:
        from qgis.utils import iface

        self._save(iface.mainWindow(), name)

    def _save(self, widget, name: str) -> None:
        widget.grab().save(str(self.out / name))


if __name__ == "__main__":
    if OUT in os.environ:
        pictures = Pictures()
        pictures.start()
    else:
        variables = {**os.environ, "QGIS_CUSTOM_CONFIG_PATH": sys.argv[1]}
        print(*take_pictures(*map(Path, sys.argv[1:4]), variables), sep="\n")
