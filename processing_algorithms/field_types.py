"""Types of fields, by the names that the version of QGIS has for them."""

from __future__ import annotations

from qgis.core import Qgis
from qgis.PyQt.QtCore import QMetaType, QVariant

if Qgis.QGIS_VERSION_INT >= 33800:
    TEXT, REAL = QMetaType.Type.QString, QMetaType.Type.Double
    WHOLE, TRUTH = QMetaType.Type.Int, QMetaType.Type.Bool
else:  # fields do not take QMetaType yet
    TEXT, REAL, WHOLE, TRUTH = QVariant.Type.String, QVariant.Type.Double, QVariant.Type.Int, QVariant.Type.Bool
