"""On-the-Fly3R for QGIS: the plugin's door."""


def classFactory(iface):
    """Return the plugin; QGIS calls this."""
    from .plugin.main import OnTheFly3RPlugin

    return OnTheFly3RPlugin(iface)
