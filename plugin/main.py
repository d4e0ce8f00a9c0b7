"""The plugin: registers the provider, adds a menu and a toolbar button."""

from __future__ import annotations

from pathlib import Path

from qgis.core import QgsApplication
from qgis.PyQt.QtCore import QUrl
from qgis.PyQt.QtGui import QDesktopServices, QGuiApplication, QIcon
from qgis.PyQt.QtWidgets import QMenu

try:
    from qgis.PyQt.QtGui import QAction
except ImportError:  # Qt 5
    from qgis.PyQt.QtWidgets import QAction

from ..processing_algorithms.base import tr
from ..processing_algorithms.provider import OnTheFly3RProvider
from . import settings
from .help_page import help_page

MENU = "On-the-Fly3R"
ICONS = Path(__file__).resolve().parents[1] / "resources" / "icons"


class OnTheFly3RPlugin:
    """What QGIS loads; `iface` is None in qgis_process."""

    def __init__(self, iface) -> None:
        self._iface = iface
        self._provider: OnTheFly3RProvider | None = None
        self._actions: list[QAction] = []

    def initProcessing(self) -> None:
        """Register the provider; all that qgis_process needs."""
        self._provider = OnTheFly3RProvider()
        QgsApplication.processingRegistry().addProvider(self._provider)

    def initGui(self) -> None:
        """Add provider, menu and toolbar button."""
        self.initProcessing()
        self._add("reconstruct.svg", tr("Reconstruct photographs…"), self.open_reconstruct, toolbar=True)
        self._add("reconstruct.svg", tr("Try with a sample flight…"), self.open_sample)
        self._add("report.svg", tr("Last report"), self.open_last_report)
        self._add_recent()
        self._add("setup.svg", tr("Set up processing environment…"), self.open_setup)
        self._add("onthefly3r.svg", tr("Help"), self.open_help)
        self._add("diagnostics.svg", tr("Copy diagnostics of the last failure"), self.copy_diagnostics)

    def unload(self) -> None:
        """Take everything away again."""
        for action in self._actions:
            self._iface.removePluginMenu(MENU, action)
            self._iface.removeToolBarIcon(action)
        self._actions.clear()
        if self._provider is not None:
            QgsApplication.processingRegistry().removeProvider(self._provider)
            self._provider = None

    def open_reconstruct(self) -> None:
        """Open the main algorithm, or the set-up while there is nothing to compute with."""
        self._open("onthefly3r:reconstruct" if settings.interpreter() else "onthefly3r:setup")

    def open_sample(self) -> None:
        """Open the sample flight, or the set-up while there is nothing to compute with."""
        self._open("onthefly3r:sampleflight" if settings.interpreter() else "onthefly3r:setup")

    def open_help(self) -> None:
        """Open the documentation in the browser."""
        QDesktopServices.openUrl(QUrl(help_page()))

    def open_setup(self) -> None:
        """Open the set-up."""
        self._open("onthefly3r:setup")

    def open_last_report(self) -> None:
        """Show the report of the last run in the browser."""
        path = settings.last_report()
        if path:
            QDesktopServices.openUrl(QUrl.fromLocalFile(path))
        else:
            self._say(tr("There is no report yet: reconstruct photographs first."))

    def copy_diagnostics(self) -> None:
        """Put what was noted of the last failure on the clipboard."""
        text = settings.diagnostics()
        QGuiApplication.clipboard().setText(text)
        self._say(tr("Copied.") if text else tr("No failure has been noted."))

    def _open(self, algorithm: str) -> None:
        import processing

        processing.execAlgorithmDialog(algorithm, {})

    def _add_recent(self) -> None:
        """Add a menu of the last runs, which is filled when it is opened."""
        self._recent = QMenu()
        self._recent.aboutToShow.connect(self.fill_recent)
        self._add("cameras.svg", tr("Recent runs"), lambda: None)
        self._actions[-1].setMenu(self._recent)

    def fill_recent(self) -> None:
        """List the runs that are still there; a click loads one's layers."""
        self._recent.clear()
        runs = settings.recent_runs()
        for run in runs:
            action = self._recent.addAction(run)
            action.triggered.connect(lambda checked=False, run=run: self.load_run(run))
        if not runs:
            self._recent.addAction(tr("None yet")).setEnabled(False)

    def load_run(self, run: str) -> None:
        """Load the layers of a run into the project."""
        import processing

        processing.runAndLoadResults("onthefly3r:loadresults", {"RUN": run})

    def _say(self, text: str) -> None:
        self._iface.messageBar().pushMessage(MENU, text)

    def _add(self, icon: str, text: str, slot, toolbar: bool = False) -> None:
        action = QAction(QIcon(str(ICONS / icon)), text, self._iface.mainWindow())
        action.triggered.connect(lambda checked=False: slot())
        self._iface.addPluginToMenu(MENU, action)
        if toolbar:
            self._iface.addToolBarIcon(action)
        self._actions.append(action)
