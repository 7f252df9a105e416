from __future__ import annotations

import json
import math

import pytest

from uvgs_bench.report.cells import Interval, Mark, Measured, Number, decimals_for, shown_number
from uvgs_bench.report.document import (
    Column,
    Document,
    Figure,
    Gallery,
    KeyFigure,
    Paragraph,
    Picture,
    Section,
    Series,
    Table,
    document_data,
)
from uvgs_bench.report.json_export import render_json

SVG = '<svg xmlns="http://www.w3.org/2000/svg"></svg>'


def document(*blocks: object, key: str = "one") -> Document:
    section = Section(key, "One", tuple(blocks))  # type: ignore[arg-type]
    return Document("Title", "run", "2026-01-02T03:04:05Z", "pass", "All good.", (), (), (section,), ())


@pytest.mark.parametrize(
    ("value", "decimals", "shown"),
    [
        (1.25, 3, "1.250"),
        (-0.0004, 3, "0.000"),
        (-0.0006, 3, "-0.001"),
        (None, 2, "–"),
        (math.nan, 2, "–"),
        (math.inf, 2, "∞"),
        (-math.inf, 2, "-∞"),
        (12.0, 0, "12"),
        (-10.0, 0, "-10"),
    ],
)
def test_a_number_is_shown_with_the_digits_asked_for(value: float | None, decimals: int, shown: str) -> None:
    assert shown_number(value, decimals) == shown


@pytest.mark.parametrize(
    ("half_widths", "decimals"),
    [([0.012], 3), ([0.12], 2), ([1.2], 1), ([12.0], 0), ([1e-9], 6), ([], 3), ([math.inf, None, 0.0], 3)],
)
def test_uncertainty_gets_two_significant_digits(half_widths: list[float | None], decimals: int) -> None:
    assert decimals_for(half_widths) == decimals


def test_an_open_interval_keeps_its_closed_end() -> None:
    interval = Interval(0.5, math.inf, 2, "mm")
    assert interval.shown == "0.50 … ∞"
    assert interval.data()["high"] is None
    assert interval.data()["low"] == 0.5


def test_an_unknown_interval_is_a_dash() -> None:
    assert Interval(None, math.nan, 2).shown == "–"


def test_a_figure_without_alternative_text_is_refused() -> None:
    with pytest.raises(ValueError, match="alternative text"):
        Figure("f", SVG, "  ", "caption")


def test_a_figure_must_be_a_drawing() -> None:
    with pytest.raises(ValueError, match="svg"):
        Figure("f", "<script>", "alt", "caption")


def test_a_picture_needs_alternative_text_and_a_png() -> None:
    with pytest.raises(ValueError, match="alternative text"):
        Picture("p", b"\x89PNG", "", "caption")
    with pytest.raises(ValueError, match="PNG"):
        Picture("p", b"GIF89a", "alt", "caption")


def test_a_row_must_have_as_many_cells_as_columns() -> None:
    with pytest.raises(ValueError, match="row of 1 cells under 2 columns"):
        Table("caption", (Column("a"), Column("b")), (("only",),))


def test_keys_are_unique_over_sections_figures_and_pictures() -> None:
    picture = Gallery((Picture("one", b"\x89PNG", "alt", "caption"),))
    with pytest.raises(ValueError, match="given twice: one"):
        document(picture)


def test_json_is_strict_and_carries_raw_value_and_shown_digits() -> None:
    cells = (
        "x",
        Number(math.nan, 2, "mm"),
        Measured(Number(1.23456, 2, "mm"), Interval(1.0, math.inf, 2, "mm")),
        Mark("fail"),
    )
    table = Table("caption", tuple(Column(c) for c in "abcd"), (cells,))
    figure = Figure("f", SVG, "alt", "caption", (Series("s", "m", (1.0, math.nan)),))

    def refuse(word: str) -> None:
        pytest.fail(f"{word} is not strict JSON")

    data = json.loads(render_json(document(Paragraph("hello"), table, figure)), parse_constant=refuse)
    assert data["schema"] == 1
    paragraph, shown, drawn = data["sections"][0]["blocks"]
    assert paragraph["text"] == "hello"
    name, absent, measured, mark = shown["rows"][0]
    assert name == {"kind": "text", "shown": "x"}
    assert absent["value"] is None
    assert absent["shown"] == "–"
    assert measured["number"] == {"kind": "number", "value": 1.23456, "shown": "1.23", "unit": "mm"}
    assert measured["shown"] == "1.23 [1.00 … ∞]"
    assert mark == {"kind": "mark", "state": "fail", "shown": "fail"}
    assert drawn["series"] == [{"name": "s", "unit": "m", "values": [1.0, None]}]
    assert "svg" not in drawn


def test_key_figures_carry_their_interval() -> None:
    figure = KeyFigure("RMS", Number(0.5, 1, "mm"), Interval(0.4, 0.6, 1, "mm"), "20 stations")
    d = Document("T", "r", "2026-01-02", "none", "h", (), (figure,), (), ())
    data = document_data(d)
    assert data["key_figures"] == [figure.data()]
    assert figure.data()["interval"] == {
        "kind": "interval",
        "low": 0.4,
        "high": 0.6,
        "shown": "0.4 … 0.6",
        "unit": "mm",
    }
    assert data["verdict"] == {"kind": "mark", "state": "none", "shown": "not judged"}
