"""The report as one web page: no network, drawings inline. Scripts only add to it; it is whole without them."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path

from uvgs_bench.report.document import Document, Figure, document_data
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
    scripts = [(TEMPLATES / name).read_text(encoding="utf-8") for name in _scripts(document)]
    template = environment.get_template("report.html.j2")
    return template.render(
        doc=document_data(document),
        drawings=drawings,
        images=images,
        live={figure.key: Markup(_live_data(figure)) for figure in document.figures() if figure.live},  # noqa: S704
        scripts=[Markup(script) for script in scripts],  # noqa: S704 - our own files
        script_hashes=[Markup(_csp_hash(script)) for script in scripts],  # noqa: S704
        has_zoom=any(figure.live == "zoom" for figure in document.figures()),
    )


def _scripts(document: Document) -> list[str]:
    """The scripts a page needs, in the order they run."""
    kinds = {figure.live for figure in document.figures()}
    zoom = ["vendor/uplot.min.js"] if "zoom" in kinds else []
    return ["tables.js", *zoom, *(["live.js"] if kinds - {""} else [])]


def _live_data(figure: Figure) -> str:
    """The numbers of a drawing as JSON that cannot end the element it stands in."""
    return json.dumps(figure.data(), ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")


def _csp_hash(script: str) -> str:
    """What the page's policy calls a script it allows: nothing else ever runs."""
    return "'sha256-" + base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii") + "'"


def _themed(svg: str) -> str:
    """Let the page choose the colours of a drawing."""
    for colour, variable in CSS_VARIABLES.items():
        svg = svg.replace(colour, f"var({variable}, {colour})")
    return svg
