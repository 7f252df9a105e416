"""Reading rendered reports back: tables of the page, cells as exported, text of the PDF."""

from __future__ import annotations

import base64
import functools
import hashlib
import io
import json
import re
from collections import Counter
from html.parser import HTMLParser
from typing import Any

from pypdf import PdfReader

from uvgs_bench.report.document import Document
from uvgs_bench.report.html import TEMPLATES, render_html
from uvgs_bench.report.json_export import render_json
from uvgs_bench.report.pdf import render_pdf


class Page(HTMLParser):
    """What a reader of the page gets: tables as text, identifiers, links, images, element names."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: Counter[str] = Counter()
        self.svgs: list[dict[str, str | None]] = []
        self.images: list[dict[str, str | None]] = []
        self.captions = 0
        self._cell: list[str] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags[tag] += 1
        if found.get("id"):
            self.ids.append(str(found["id"]))
        if found.get("href"):
            self.links.append(str(found["href"]))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self._cell = []
        elif tag == "svg":
            self.svgs.append(found)
        elif tag == "img":
            self.images.append(found)
        elif tag == "caption":
            self.captions += 1

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th") and self._cell is not None:
            self.tables[-1][-1].append(" ".join("".join(self._cell).split()))
            self._cell = None

    def handle_data(self, data: str) -> None:
        if self._cell is not None:
            self._cell.append(f" {data} ")


def tables_of(data: dict[str, Any]) -> list[dict[str, Any]]:
    """All tables of an exported report."""
    return [block for section in data["sections"] for block in section["blocks"] if block["kind"] == "table"]


def as_shown(cell: dict[str, Any], unit_in_heading: str) -> str:
    """The words of a table cell on the page, from the exported values alone."""
    if cell["kind"] == "measured":
        unit = "" if unit_in_heading else cell["number"]["unit"]
        return " ".join(f"{cell['number']['shown']} {unit} {cell['interval']['shown']}".split())
    unit = "" if unit_in_heading or cell["shown"] == "–" else cell.get("unit", "")
    return " ".join(f"{cell['shown']} {unit}".split())


@functools.cache
def pdf_text(pdf: bytes) -> str:
    """All words of a PDF without spaces."""
    pages = PdfReader(io.BytesIO(pdf)).pages
    return "".join("".join(page.extract_text().split()) for page in pages)


def squeezed(text: str) -> str:
    """Without spaces."""
    return "".join(text.split())


def check_same_tables(page: str, data: dict[str, Any]) -> int:
    """Every table cell of the page is the exported one; returns how many tables there are."""
    shown, exported = Page(page).tables, tables_of(data)
    assert len(shown) == len(exported)
    for table, expected in zip(shown, exported, strict=True):
        rows = [
            [
                cell["shown"] if i == 0 else as_shown(cell, column["unit"])
                for i, (cell, column) in enumerate(zip(row, expected["columns"], strict=True))
            ]
            for row in expected["rows"]
        ]
        assert table[1:] == [[" ".join(cell.split()) for cell in row] for row in rows], expected["caption"]
    return len(shown)


def missing_in_pdf(pdf: bytes, data: dict[str, Any]) -> list[tuple[str, str]]:
    """Exported numbers and words of tables and key figures that the PDF does not show."""
    text = pdf_text(pdf)
    missing = [
        ("key figure", figure["label"])
        for figure in data["key_figures"]
        if squeezed(figure["number"]["shown"] + figure["number"]["unit"]) not in text
    ]
    for table in tables_of(data):
        for cell in (cell for row in table["rows"] for cell in row):
            is_measured = cell["kind"] == "measured"
            parts = (cell["number"]["shown"], cell["interval"]["shown"]) if is_measured else (cell["shown"],)
            missing += [(table["caption"], part) for part in parts if squeezed(part) not in text]
    return missing


def check_only_own_scripts(page: str) -> None:
    """Every script stands in the page, is one of ours to the letter, and is what the page's policy allows."""
    allowed = set(re.findall(r"'(sha256-[^']+)'", page[: page.index("<title>")]))
    own = {path.read_text(encoding="utf-8") for path in TEMPLATES.rglob("*.js")}
    found = re.findall(r"<script([^>]*)>(.*?)</script>", page, flags=re.DOTALL)
    assert page.lower().count("<script") == len(found)
    for attributes, text in found:
        if "application/json" in attributes:
            json.loads(text)
            continue
        assert attributes == ""
        assert text in own
        assert "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() in allowed


def check_page_is_whole(page: str, document: Document) -> None:
    """The page needs nothing but itself, names its pictures, and its links arrive."""
    found = Page(page)
    assert not found.tags & Counter({"link": 1, "iframe": 1, "object": 1})
    check_only_own_scripts(page)
    assert [name for name, count in Counter(found.ids).items() if count > 1] == []
    assert {link for link in found.links if link.startswith("#")} <= {f"#{name}" for name in found.ids}
    assert len(found.svgs) == len(document.figures())
    assert all(len(str(svg["aria-label"])) > 20 for svg in found.svgs)
    assert len(found.images) == len(document.pictures())
    assert all(image["alt"] for image in found.images)


def check_three_agree(document: Document) -> dict[str, Any]:
    """HTML, PDF and JSON show the same verdict, headline and figures; returns the exported data."""
    page, pdf = render_html(document), render_pdf(document)
    data: dict[str, Any] = json.loads(render_json(document))
    check_page_is_whole(page, document)
    assert check_same_tables(page, data) > 0
    assert missing_in_pdf(pdf, data) == []
    assert f'<p class="word">{data["verdict"]["shown"]}</p>' in page
    assert squeezed(data["verdict"]["shown"].upper() + data["headline"]) in pdf_text(pdf)
    for figure in document.figures():
        assert any(letter.isdigit() for letter in figure.alt), figure.key
        assert "nan" not in figure.alt, figure.key
    return data
