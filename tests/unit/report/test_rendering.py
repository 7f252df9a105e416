"""One document, three files: the same numbers, safe, self-contained, the same bytes each time."""

from __future__ import annotations

import io
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from pypdf import PdfReader

from tests.helpers.rendered import Page, check_only_own_scripts, check_same_tables, missing_in_pdf, pdf_text, squeezed
from tests.helpers.synthetic_run import (
    HOSTILE,
    LIMIT_VERDICTS,
    synthetic_judgement,
    synthetic_run,
    with_pictures,
)
from uvgs_bench.accuracy.judgement import Alert
from uvgs_bench.report import Document, build_document
from uvgs_bench.report.html import render_html
from uvgs_bench.report.json_export import render_json
from uvgs_bench.report.pdf import render_pdf

pytestmark = pytest.mark.opencv


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reports") / "20260102T030405Z_synthetic"


@pytest.fixture(scope="module")
def document(run_folder: Path) -> Document:
    run = with_pictures(synthetic_run(run_folder, stations=18, procedure=HOSTILE), every=3)
    alerts = (Alert("warning", HOSTILE), Alert("note", "all well"))
    return build_document(run, synthetic_judgement(run, "fail", LIMIT_VERDICTS, alerts))


@pytest.fixture(scope="module")
def page(document: Document) -> str:
    return render_html(document)


@pytest.fixture(scope="module")
def pdf(document: Document) -> bytes:
    return render_pdf(document)


@pytest.fixture(scope="module")
def data(document: Document) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(render_json(document))
    return loaded


def test_every_table_cell_is_the_same_on_the_page_as_in_json(page: str, data: dict[str, Any]) -> None:
    assert check_same_tables(page, data) > 10


def test_every_number_of_json_stands_in_the_pdf(pdf: bytes, data: dict[str, Any]) -> None:
    assert missing_in_pdf(pdf, data) == []


def test_the_verdict_is_the_same_in_all_three(page: str, pdf: bytes, data: dict[str, Any]) -> None:
    assert data["verdict"]["state"] == "fail"
    assert '<section class="verdict fail"' in page
    assert f'<p class="word">{data["verdict"]["shown"]}</p>' in page
    assert squeezed("FAIL" + data["headline"]) in pdf_text(pdf)


def test_outside_text_is_never_interpreted(page: str, pdf: bytes) -> None:
    assert "<script>alert" not in page.lower()
    check_only_own_scripts(page)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    # typst would print "x" in bold if the text were markup; it must stand there letter by letter.
    assert "#strong[x]" in pdf_text(pdf)
    assert "$math$" in pdf_text(pdf)


def test_the_page_needs_nothing_but_itself(page: str) -> None:
    addresses = set(re.findall(r"https?://[^\s\"'<>)]+", page))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    found = Page(page)
    assert not found.tags & Counter({"link": 1, "iframe": 1, "object": 1})
    assert all(str(image["src"]).startswith("data:image/png;base64,") for image in found.images)


def test_the_page_serves_readers_who_cannot_see_it(page: str, document: Document) -> None:
    found = Page(page)
    assert len(found.svgs) == len(document.figures()) >= 12
    for svg in found.svgs:
        assert svg["role"] == "img"
        assert len(str(svg["aria-label"])) > 20
    assert len(found.images) == len(document.pictures()) > 0
    assert all(image["alt"] for image in found.images)
    assert found.captions == len(found.tables)
    for landmark in ("header", "nav", "main", "footer"):
        assert found.tags[landmark] == 1
    assert '<html lang="en">' in page
    assert found.links[0] == "#content"


def test_identifiers_are_unique_and_links_arrive(page: str) -> None:
    found = Page(page)
    twice = [name for name, count in Counter(found.ids).items() if count > 1]
    assert twice == []
    assert {link for link in found.links if link.startswith("#")} <= {f"#{name}" for name in found.ids}
    assert set(re.findall(r"url\(#([^)]+)\)", page)) <= set(found.ids)


def test_every_alternative_text_states_numbers(document: Document) -> None:
    for figure in document.figures():
        assert re.search(r"\d", figure.alt), figure.key
        assert "nan" not in figure.alt, figure.key


def test_the_pdf_is_titled_tagged_numbered_and_brings_its_fonts(pdf: bytes, document: Document) -> None:
    reader = PdfReader(io.BytesIO(pdf))
    assert reader.metadata is not None
    assert document.subtitle in str(reader.metadata.title)
    assert reader.trailer["/Root"]["/MarkInfo"]["/Marked"]  # type: ignore[index]
    assert "\u200b" not in pdf_text(pdf)
    for number, sheet in enumerate(reader.pages, start=1):
        assert f"{number}/{len(reader.pages)}" in squeezed(sheet.extract_text())
        for font in sheet["/Resources"]["/Font"].values():  # type: ignore[index]
            descendant = font.get_object()["/DescendantFonts"][0].get_object()
            assert any(key.startswith("/FontFile") for key in descendant["/FontDescriptor"].get_object())
    assert len(reader.outline) == len(document.sections) + 1


def test_building_twice_gives_the_same_bytes(run_folder: Path, document: Document, page: str, pdf: bytes) -> None:
    run = with_pictures(synthetic_run(run_folder, stations=18, procedure=HOSTILE), every=3)
    alerts = (Alert("warning", HOSTILE), Alert("note", "all well"))
    again = build_document(run, synthetic_judgement(run, "fail", LIMIT_VERDICTS, alerts))
    assert render_html(again) == page
    assert render_pdf(again) == pdf
    assert render_json(again) == render_json(document)
