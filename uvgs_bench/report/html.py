"""The report as one web page: no network, no script needed, drawings inline."""

from __future__ import annotations

import base64
from pathlib import Path

from uvgs_bench.report.document import Document, document_data
from uvgs_bench.report.palette import CSS_VARIABLES

TEMPLATES = Path(__file__).parent / "templates"


def render_html(document: Document) -> str:
    """Render the page. Every text is escaped by the template engine; only our own drawings go in as they are.

    Args:
        document: The report.

    Returns:
        A complete HTML page; the same document gives the same bytes.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    drawings = {figure.key: Markup(_themed(figure.svg)) for figure in document.figures()}  # noqa: S704 - drawn by us
    images = {
        picture.key: "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")
        for picture in document.pictures()
    }
    template = environment.get_template("report.html.j2")
    return template.render(doc=document_data(document), drawings=drawings, images=images)


def _themed(svg: str) -> str:
    """Let the page choose the colours of a drawing."""
    for colour, variable in CSS_VARIABLES.items():
        svg = svg.replace(colour, f"var({variable}, {colour})")
    return svg
