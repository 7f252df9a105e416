"""A report as plain data: every number once, with its unit and the digits it is shown with.

HTML, PDF and JSON all render :func:`document_data` of one :class:`Document`, so they cannot disagree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

SCHEMA = 1
"""Version of the exported structure; it grows when a reader of old exports would misread a new one."""

ABSENT = "–"
State = Literal["pass", "fail", "inconclusive", "none"]
Level = Literal["info", "warning", "danger"]
Data = dict[str, object]


def shown_number(value: float | None, decimals: int) -> str:
    """A number as people read it.

    Args:
        value: The number; None and NaN mean that there is none.
        decimals: Digits after the point.

    Returns:
        Fixed-point text; a dash for an absent number, an infinity sign for an unbounded one.
    """
    if value is None or math.isnan(value):
        return ABSENT
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:.{decimals}f}"
    # A rounded "-0.000" claims a sign the digits do not carry.
    return text[1:] if text.startswith("-") and not text.strip("-0.") else text


def decimals_for(half_widths: Iterable[float | None], *, default: int = 3, most: int = 6) -> int:
    """Digits after the point that give the typical uncertainty two significant digits.

    Args:
        half_widths: Half widths of the intervals (or the numbers themselves), in the unit shown.
        default: What to use when none is finite and positive.
        most: Upper bound.

    Returns:
        Digits after the point, 0 to ``most``.
    """
    usable = sorted(w for w in half_widths if w is not None and math.isfinite(w) and w > 0.0)
    if not usable:
        return default
    return max(0, min(most, 1 - math.floor(math.log10(usable[len(usable) // 2]))))


def _strict(value: float | None) -> float | None:
    """A value strict JSON can carry."""
    return None if value is None or not math.isfinite(value) else float(value)


@dataclass(frozen=True, slots=True)
class Number:
    """A number with its unit.

    Args:
        value: The raw number, or None when there is none.
        decimals: Digits shown after the point.
        unit: Unit as printed, empty for none.
    """

    value: float | None
    decimals: int
    unit: str = ""

    @property
    def shown(self) -> str:
        """The digits, without unit."""
        return shown_number(self.value, self.decimals)

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "number", "value": _strict(self.value), "shown": self.shown, "unit": self.unit}


@dataclass(frozen=True, slots=True)
class Interval:
    """An interval with its unit.

    Args:
        low: Lower end; None when unknown, -inf when unbounded.
        high: Upper end; None when unknown, inf when unbounded.
        decimals: Digits shown after the point.
        unit: Unit as printed.
    """

    low: float | None
    high: float | None
    decimals: int
    unit: str = ""

    @property
    def shown(self) -> str:
        """Both ends, without unit; a dash when neither is known."""
        low, high = shown_number(self.low, self.decimals), shown_number(self.high, self.decimals)
        return ABSENT if low == high == ABSENT else f"{low} … {high}"

    def data(self) -> Data:
        """Plain values for rendering and export."""
        ends = {"low": _strict(self.low), "high": _strict(self.high)}
        return {"kind": "interval", **ends, "shown": self.shown, "unit": self.unit}


@dataclass(frozen=True, slots=True)
class Measured:
    """A number with its interval in one cell; both in the same unit."""

    number: Number
    interval: Interval

    @property
    def shown(self) -> str:
        """The number, then its interval in brackets."""
        return f"{self.number.shown} [{self.interval.shown}]"

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "measured", "number": self.number.data(), "interval": self.interval.data(), "shown": self.shown}


@dataclass(frozen=True, slots=True)
class Mark:
    """A verdict in one word; colour only repeats what the word says."""

    state: State
    word: str = ""

    @property
    def shown(self) -> str:
        """The word."""
        return self.word or {"none": "not judged"}.get(self.state, self.state)

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "mark", "state": self.state, "shown": self.shown}


Cell = str | Number | Interval | Measured | Mark


def cell_data(cell: Cell) -> Data:
    """Plain values of a table cell."""
    return {"kind": "text", "shown": cell} if isinstance(cell, str) else cell.data()


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Running text."""

    text: str

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "paragraph", "text": self.text}


@dataclass(frozen=True, slots=True)
class Alert:
    """One thing to know before trusting a number."""

    level: Level
    text: str

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"level": self.level, "text": self.text}


@dataclass(frozen=True, slots=True)
class Alerts:
    """Alerts, the gravest first as given."""

    items: tuple[Alert, ...]

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "alerts", "items": [item.data() for item in self.items]}


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """A headline number.

    Args:
        label: What it is.
        number: The value.
        interval: Its 95 % interval, or None.
        note: What people must know to read it, short.
    """

    label: str
    number: Number
    interval: Interval | None = None
    note: str = ""

    def data(self) -> Data:
        """Plain values for rendering and export."""
        interval = None if self.interval is None else self.interval.data()
        return {"label": self.label, "number": self.number.data(), "interval": interval, "note": self.note}


@dataclass(frozen=True, slots=True)
class Column:
    """A table column.

    Args:
        label: Heading.
        unit: Unit of all its numbers, printed in the heading; empty when cells differ.
        is_numeric: Whether cells align to the right.
    """

    label: str
    unit: str = ""
    is_numeric: bool = False

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"label": self.label, "unit": self.unit, "numeric": self.is_numeric}


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first column names the row.

    Args:
        caption: What the table says.
        columns: The columns.
        rows: One tuple of cells per row, as long as the columns.

    Raises:
        ValueError: A row has another length, or the caption is empty.
    """

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        if not self.caption:
            raise ValueError("a table needs a caption")
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table '{self.caption}': row of {len(row)} cells under {len(self.columns)} columns")

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {
            "kind": "table",
            "caption": self.caption,
            "columns": [column.data() for column in self.columns],
            "rows": [[cell_data(cell) for cell in row] for row in self.rows],
        }


@dataclass(frozen=True, slots=True)
class Series:
    """The numbers behind a figure, so that nobody has to read them off the picture."""

    name: str
    unit: str
    values: tuple[float, ...]

    def data(self) -> Data:
        """Plain values for export."""
        return {"name": self.name, "unit": self.unit, "values": [_strict(v) for v in self.values]}


@dataclass(frozen=True, slots=True)
class Figure:
    """A vector drawing.

    Args:
        key: Short name, unique in the document; becomes an anchor.
        svg: The drawing, one ``<svg>`` element.
        alt: The message of the figure in words with numbers, for those who cannot see it.
        caption: What is drawn, with units.
        series: The numbers drawn.

    Raises:
        ValueError: No alternative text, or no drawing.
    """

    key: str
    svg: str
    alt: str
    caption: str
    series: tuple[Series, ...] = ()

    def __post_init__(self) -> None:
        if not self.alt.strip():
            raise ValueError(f"figure '{self.key}' needs an alternative text")
        if not self.svg.startswith("<svg"):
            raise ValueError(f"figure '{self.key}' needs one svg element")

    def data(self) -> Data:
        """Plain values for export; the drawing itself is added by the renderers that show it."""
        return {
            "kind": "figure",
            "key": self.key,
            "alt": self.alt,
            "caption": self.caption,
            "series": [series.data() for series in self.series],
        }


@dataclass(frozen=True, slots=True)
class Picture:
    """A raster image of the gallery.

    Args:
        key: Short name, unique in the document.
        png: The file's bytes.
        alt: What is to be seen, in words with numbers; required.
        caption: Printed below.

    Raises:
        ValueError: No alternative text, or no PNG.
    """

    key: str
    png: bytes = field(repr=False)
    alt: str
    caption: str

    def __post_init__(self) -> None:
        if not self.alt.strip():
            raise ValueError(f"picture '{self.key}' needs an alternative text")
        if not self.png.startswith(b"\x89PNG"):
            raise ValueError(f"picture '{self.key}' needs the bytes of a PNG file")

    def data(self) -> Data:
        """Plain values for export; the image itself is added by the renderers that show it."""
        return {"key": self.key, "alt": self.alt, "caption": self.caption}


@dataclass(frozen=True, slots=True)
class Gallery:
    """Pictures side by side."""

    pictures: tuple[Picture, ...]

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "gallery", "pictures": [picture.data() for picture in self.pictures]}


@dataclass(frozen=True, slots=True)
class Definitions:
    """Terms and what they mean here."""

    items: tuple[tuple[str, str], ...]

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"kind": "definitions", "items": [{"term": term, "text": text} for term, text in self.items]}


Block = Paragraph | Alerts | Table | Figure | Gallery | Definitions


@dataclass(frozen=True, slots=True)
class Section:
    """A chapter.

    Args:
        key: Short name, unique in the document; becomes an anchor.
        title: Heading.
        blocks: Its content in reading order.
    """

    key: str
    title: str
    blocks: tuple[Block, ...]

    def data(self) -> Data:
        """Plain values for rendering and export."""
        return {"key": self.key, "title": self.title, "blocks": [block.data() for block in self.blocks]}


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report.

    Args:
        title: Title.
        subtitle: Which run, in one line.
        created_utc: When the run was made (never when the report was built: the same run gives the same bytes).
        verdict: The overall verdict.
        headline: The verdict as one sentence.
        banners: What must be read before anything else: simulated, interrupted.
        key_figures: Headline numbers.
        sections: The chapters.
        provenance: Name and value of everything the numbers depend on, as text.

    Raises:
        ValueError: Two sections, figures or pictures share a key.
    """

    title: str
    subtitle: str
    created_utc: str
    verdict: State
    headline: str
    banners: tuple[Alert, ...]
    key_figures: tuple[KeyFigure, ...]
    sections: tuple[Section, ...]
    provenance: tuple[tuple[str, str], ...]

    def __post_init__(self) -> None:
        keys = [s.key for s in self.sections] + [f.key for f in self.figures()] + [p.key for p in self.pictures()]
        twice = sorted({key for key in keys if keys.count(key) > 1})
        if twice:
            raise ValueError(f"keys must be unique in a document, given twice: {', '.join(twice)}")

    def figures(self) -> tuple[Figure, ...]:
        """All vector figures in reading order."""
        return tuple(b for s in self.sections for b in s.blocks if isinstance(b, Figure))

    def pictures(self) -> tuple[Picture, ...]:
        """All raster pictures in reading order."""
        return tuple(p for s in self.sections for b in s.blocks if isinstance(b, Gallery) for p in b.pictures)


def document_data(document: Document) -> Data:
    """The document as plain lists, mappings, strings, numbers and None: what every renderer reads.

    Args:
        document: The document.

    Returns:
        Values strict JSON can carry; absent and unbounded numbers are None, their shown text says which.
    """
    return {
        "schema": SCHEMA,
        "kind": "uvgs_report",
        "title": document.title,
        "subtitle": document.subtitle,
        "created_utc": document.created_utc,
        "verdict": Mark(document.verdict).data(),
        "headline": document.headline,
        "banners": [banner.data() for banner in document.banners],
        "key_figures": [figure.data() for figure in document.key_figures],
        "sections": [section.data() for section in document.sections],
        "provenance": [{"name": name, "value": value} for name, value in document.provenance],
    }
