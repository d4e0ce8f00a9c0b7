"""The Processing provider."""

from __future__ import annotations

from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from ..core.onthefly3r import __version__
from ..plugin import settings
from .base import ICONS, tr
from .check_photographs import CheckPhotographs
from .evaluate import Evaluate
from .export_cameras import ExportCameras
from .export_cloud import ExportCloud
from .georeference import Georeference
from .load_results import LoadResults
from .reconstruct import ReconstructPhotographs
from .reconstruct_flights import ReconstructFlights
from .sample_flight import SampleFlight
from .setup_environment import SetUpEnvironment

ALGORITHMS = (
    ReconstructPhotographs,
    SampleFlight,
    LoadResults,
    ExportCloud,
    ExportCameras,
    Georeference,
    ReconstructFlights,
    CheckPhotographs,
    Evaluate,
    SetUpEnvironment,
)


class OnTheFly3RProvider(QgsProcessingProvider):
    """Everything under On-the-Fly3R in the toolbox."""

    def id(self) -> str:
        """Return the provider's id."""
        return "onthefly3r"

    def name(self) -> str:
        """Return the provider's name."""
        return "On-the-Fly3R"

    def longName(self) -> str:
        """Return the provider's name with its version."""
        return f"On-the-Fly3R {__version__}"

    def versionInfo(self) -> str:
        """Return the version."""
        return __version__

    def icon(self) -> QIcon:
        """Return the icon."""
        return QIcon(self.svgIconPath())

    def svgIconPath(self) -> str:
        """Return the icon's file."""
        return str(ICONS / "onthefly3r.svg")

    def supportedOutputPointCloudLayerExtensions(self) -> list[str]:
        """Return the endings of clouds; asked from QGIS 3.24 on."""
        return ["laz", "las"]

    def defaultPointCloudFileExtension(self) -> str:
        """Return the ending of temporary clouds; asked from QGIS 3.24 on."""
        return "laz"

    def load(self) -> bool:
        """Add the settings to Processing's options page, then the algorithms."""
        from processing.core.ProcessingConfig import ProcessingConfig, Setting

        ProcessingConfig.settingIcons[self.name()] = self.icon()
        ProcessingConfig.addSetting(
            Setting(
                self.name(),
                settings.PYTHON,
                tr("Existing Python 3.10 or newer with the packages (for offices without internet)"),
                "",
                valuetype=Setting.FILE,
            )
        )
        ProcessingConfig.addSetting(
            Setting(
                self.name(),
                settings.ENVIRONMENT,
                tr("Folder of the processing environment"),
                "",
                valuetype=Setting.STRING,
                placeholder=settings.default_environment_folder(),
            )
        )
        for name, title, empty in (
            (settings.MODELS, tr("Folder of the weights of neural backbones"), settings.default_models_folder()),
            (settings.CACHE, tr("Folder of temporary files of a run"), tr("that of the system")),
        ):
            ProcessingConfig.addSetting(
                Setting(self.name(), name, title, "", valuetype=Setting.STRING, placeholder=empty)
            )
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        """Take the settings away again."""
        from processing.core.ProcessingConfig import ProcessingConfig

        for name in (settings.PYTHON, settings.ENVIRONMENT, settings.MODELS, settings.CACHE):
            ProcessingConfig.removeSetting(name)

    def loadAlgorithms(self) -> None:
        """Add every algorithm."""
        for algorithm in ALGORITHMS:
            self.addAlgorithm(algorithm())
