"""The report as PDF: set by typst from a fixed template that reads the numbers as JSON, drawings as vectors."""

from __future__ import annotations

import json
import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from uvgs_bench.errors import UvgsError
from uvgs_bench.report.document import Document, document_data

TEMPLATE = Path(__file__).parent / "templates" / "report.typ"


def render_pdf(document: Document) -> bytes:
    """Render a tagged PDF with its fonts embedded.

    Args:
        document: The report.

    Returns:
        The file's bytes; the same document gives the same bytes.

    Raises:
        UvgsError: The typesetter refused; its message is a defect of ours or of the installation.
    """
    pages = _compile(document, "pdf")
    return pages if isinstance(pages, bytes) else pages[0]


def render_pages(document: Document, ppi: float = 60.0) -> list[bytes]:
    """Render the pages of the PDF as PNG images, for looking at them.

    Args:
        document: The report.
        ppi: Resolution, pixels per inch.

    Returns:
        One PNG per page.

    Raises:
        UvgsError: As ``render_pdf``.
    """
    pages = _compile(document, "png", ppi)
    return [pages] if isinstance(pages, bytes) else pages


def _compile(document: Document, kind: Literal["pdf", "png"], ppi: float | None = None) -> bytes | list[bytes]:
    import matplotlib
    import typst

    with tempfile.TemporaryDirectory(prefix="uvgs_report_") as name:
        folder = Path(name)
        shutil.copyfile(TEMPLATE, folder / "report.typ")
        (folder / "data.json").write_text(json.dumps(document_data(document), allow_nan=False), encoding="utf-8")
        for figure in document.figures():
            (folder / f"{figure.key}.svg").write_text(figure.svg, encoding="utf-8")
        for picture in document.pictures():
            (folder / f"{picture.key}.png").write_bytes(picture.png)
        fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
        options: dict[str, Any] = {} if ppi is None else {"ppi": ppi}
        try:
            # System fonts are ignored so that every machine makes the same page.
            compiler = typst.Compiler(
                str(folder / "report.typ"), root=str(folder), font_paths=[str(fonts)], ignore_system_fonts=True
            )
            result = compiler.compile(format=kind, timestamp=_timestamp(document.created_utc), **options)
        except typst.TypstError as error:
            raise UvgsError(f"the PDF cannot be set: {error}") from error
    if result is None:
        raise UvgsError("the PDF cannot be set: the typesetter returned nothing")
    return result


def _timestamp(created_utc: str) -> datetime:
    """The instant written into the file: the run's, so that building twice gives the same bytes."""
    try:
        instant = datetime.fromisoformat(created_utc)
    except ValueError:
        return datetime(1970, 1, 1, tzinfo=UTC)
    # The typesetter knows whole seconds only.
    return instant.replace(microsecond=0, tzinfo=instant.tzinfo or UTC)
