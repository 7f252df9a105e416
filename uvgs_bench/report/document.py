"""A report as plain data: every number once, with its unit and the digits it is shown with.

HTML, PDF and JSON all render :func:`document_data` of one :class:`Document`, so they cannot disagree.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from uvgs_bench.report.cells import Cell, Data, Interval, Mark, Number, State, cell_data, strict

SCHEMA = 1
"""Version of the exported structure; it grows when a reader of old exports would misread a new one."""

Level = Literal["info", "warning", "danger"]
Live = Literal["", "zoom", "space"]
"""What a script may add to a drawing: nothing; a chart that zooms; a view in space that turns."""


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
        return {"name": self.name, "unit": self.unit, "values": [strict(v) for v in self.values]}


@dataclass(frozen=True, slots=True)
class Figure:
    """A vector drawing.

    Args:
        key: Short name, unique in the document; becomes an anchor.
        svg: The drawing, one ``<svg>`` element.
        alt: The message of the figure in words with numbers, for those who cannot see it.
        caption: What is drawn, with units.
        series: The numbers drawn.
        live: What a script on the page may make of them; the drawing always stands without it. For ``zoom`` every
            series in seconds begins a group, and those after it are drawn over it. For ``space`` the series are, of
            each station in camera axes, x, y, z in m, x, y, z of its mean error in mm, the angle of its mean attitude
            error in deg, whether it fitted the registration (1) or judges (0); last, how many times longer than true
            errors are drawn.

    Raises:
        ValueError: No alternative text, or no drawing.
    """

    key: str
    svg: str
    alt: str
    caption: str
    series: tuple[Series, ...] = ()
    live: Live = ""

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
            "live": self.live,
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
        created_utc: When the run was made (never when the report was built: the same run gives the same bytes); empty
            where the report follows from its inputs alone.
        verdict: The overall verdict.
        headline: The verdict as one sentence.
        banners: What must be read before anything else: simulated, interrupted.
        key_figures: Headline numbers.
        sections: The chapters.
        provenance: Name and value of everything the numbers depend on, as text.
        genre: What kind of report it is, in two words.
        subject: What was done at ``created_utc``, in one word.
        verdict_word: The verdict as printed, where the plain word says too little.

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
    genre: str = "accuracy report"
    subject: str = "run"
    verdict_word: str = ""

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
        "genre": document.genre,
        "subject": document.subject,
        "title": document.title,
        "subtitle": document.subtitle,
        "created_utc": document.created_utc,
        "verdict": Mark(document.verdict, document.verdict_word).data(),
        "headline": document.headline,
        "banners": [banner.data() for banner in document.banners],
        "key_figures": [figure.data() for figure in document.key_figures],
        "sections": [section.data() for section in document.sections],
        "provenance": [{"name": name, "value": value} for name, value in document.provenance],
    }
