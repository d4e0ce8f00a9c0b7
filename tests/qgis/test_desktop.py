"""The desktop starts with the plugin, and the plugin works in it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

PICTURES = ("qgis-check", "qgis-reconstruct", "qgis-report", "qgis-result", "qgis-toolbox")


@pytest.fixture(scope="module")
def pictures(
    profiles: Path, survey: Path, qgis_environ: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Pictures of the desktop's windows, with layers loaded by the plugin."""
    from qgis_pictures import take_pictures

    for program in ("qgis", "Xvfb"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    out = tmp_path_factory.mktemp("pictures")
    taken = take_pictures(profiles, survey / "photos", out, qgis_environ)
    assert [path.stem for path in taken] == list(PICTURES)
    return out


def colours(path: Path) -> set[int]:
    from qgis.PyQt.QtGui import QImage

    picture = QImage(str(path))
    assert picture.width() >= 200 and picture.height() >= 400
    return {picture.pixel(x, y) for x in range(0, picture.width(), 2) for y in range(0, picture.height(), 2)}


@pytest.mark.desktop
@pytest.mark.parametrize("name", PICTURES)
def test_windows_show_something(pictures: Path, name: str) -> None:
    assert len(colours(pictures / f"{name}.png")) > 200


@pytest.mark.desktop
def test_map_shows_cameras_over_the_ground(pictures: Path) -> None:
    from qgis.PyQt.QtGui import QColor, QImage

    picture = QImage(str(pictures / "qgis-result.png"))
    canvas = [QColor(picture.pixel(x, y)) for x in range(400, 800, 2) for y in range(200, 680, 2)]
    white = sum(min(colour.red(), colour.green(), colour.blue()) > 245 for colour in canvas)
    assert white < 0.8 * len(canvas)  # the surface, in the colours of its heights or of the photographs
    assert len({colour.rgb() for colour in canvas}) > 200
