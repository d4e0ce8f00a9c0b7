"""The QGIS side: menu, settings, and the worker that runs the core in its own interpreter."""
