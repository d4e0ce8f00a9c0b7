"""The documentation that travels with the plugin, as a page for the browser."""

from __future__ import annotations

import re
from pathlib import Path

from qgis.PyQt.QtCore import QStandardPaths, QUrl
from qgis.PyQt.QtGui import QGuiApplication, QTextDocument

from ..core.onthefly3r import __version__
from .places import file_url

DOCS = Path(__file__).resolve().parents[1] / "docs"
STYLE = (
    "<style>body{max-width:52em;margin:2em auto;font-family:sans-serif;line-height:1.4}td,th{padding:.2em .6em}</style>"
)


def help_page(name: str = "qgis") -> str:
    """Return the address of a page of the documentation: HTML where Qt can make it, else its source."""
    source = DOCS / f"{name}.md"
    folder = Path(QStandardPaths.writableLocation(QStandardPaths.StandardLocation.GenericCacheLocation), "onthefly3r")
    page = folder / f"{name}-{__version__}-{int(source.stat().st_mtime)}.html"
    try:
        if not page.is_file():
            if QGuiApplication.instance() is None:  # qgis_process: nobody looks at it there
                return source.as_uri()
            folder.mkdir(parents=True, exist_ok=True)
            page.write_text(as_html(source), encoding="utf-8")
    except OSError:
        return source.as_uri()
    return QUrl.fromLocalFile(str(page)).toString()


def as_html(source: Path) -> str:
    """Return a Markdown file as HTML whose pictures and links point into the folder that it is in."""
    document = QTextDocument()
    document.setMarkdown(source.read_text(encoding="utf-8"))
    html = document.toHtml()
    html = re.sub(r' style="[^"]*"', "", html)  # Qt writes its own fonts and margins into every element
    html = re.sub(
        r'(src|href)="(?!\w+:|#)([^"#]+)', lambda link: f'{link[1]}="{file_url(source.parent / link[2])}', html
    )
    return html.replace("<head>", f'<head><meta charset="utf-8"/>{STYLE}', 1)
