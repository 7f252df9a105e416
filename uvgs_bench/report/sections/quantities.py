"""The figures laboratories ask for by name, of the whole run and of groups of its captures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.quantity_catalogue import Quantity
from uvgs_bench.report.cells import Cell, Number, decimals_for
from uvgs_bench.report.document import Block, Column, Definitions, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import plain_axes, series, style, svg_of
from uvgs_bench.report.palette import FAINT, SERIES
from uvgs_bench.report.quantities import LARGEST_WORDS, SCALES, Scale, decimals_of, measured
from uvgs_bench.store.run import Run

_GROUP_WORDS = {
    "range": "range",
    "view_angle": "angle between the beacon's axis and the line of sight",
    "zone": "zone of the picture",
    "exposure": "exposure time, which follows the light",
}
_DRAWN = "position_rms"


def build(run: Run, judgement: Judgement) -> Section | None:
    """Quantities with intervals, counts and definitions."""
    del run
    whole = [q for q in judgement.quantities if not q.group]
    grouped = [q for q in judgement.quantities if q.group]
    if not whole:
        return None
    given = [q for q in whole if np.isfinite(q.estimate.value)]
    missing = [q for q in whole if not np.isfinite(q.estimate.value)]
    text = (
        "Named figures of the captures that judge, each with the text it follows. A figure that this run cannot give "
        "is listed with the reason; none is guessed."
    )
    blocks: list[Block] = [Paragraph(text)]
    if given:
        blocks.append(_table(given))
    if missing:
        rows = tuple((q.name, q.estimate.note or "not recorded") for q in missing)
        blocks.append(Table("Figures this run cannot give.", (Column("Quantity"), Column("Because")), rows))
    blocks += _groups(grouped)
    blocks.append(Definitions(tuple((q.name, f"{q.definition} Source: {q.source}.") for q in whole)))
    return Section("quantities", "Quantities by name", tuple(blocks))


def _table(given: Sequence[Quantity]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for q in given:
        worth = q.estimate.effective_count
        rows.append(
            (
                q.name,
                _shown(q),
                Number(q.estimate.station_count, 0),
                Number(q.estimate.capture_count, 0),
                Number(worth if worth > 0.0 else None, 0),
                "; ".join(filter(None, (_largest_note(q), q.estimate.note))),
            )
        )
    columns = (
        Column("Quantity"),
        Column("Figure", is_numeric=True),
        Column("Places", is_numeric=True),
        Column("Captures", is_numeric=True),
        Column("Worth", is_numeric=True),
        Column("Note"),
    )
    caption = (
        "Figures with their 95 % intervals. Worth: how many independent captures the captures amount to; a dash where "
        "the interval rests on places alone."
    )
    return Table(caption, columns, tuple(rows))


def _scale(q: Quantity) -> Scale:
    # Of no unit are only shares of captures; people read them in percent.
    return SCALES["percent" if q.unit == "1" else q.unit]


def _is_largest(q: Quantity) -> bool:
    e = q.estimate
    return q.key.endswith("_max") and e.low == e.value == e.high


def _largest_note(q: Quantity) -> str:
    return f"the largest seen: {LARGEST_WORDS}" if _is_largest(q) else ""


def _shown(q: Quantity) -> Cell:
    scale = _scale(q)
    if _is_largest(q):
        value = q.estimate.value * scale.factor
        return Number(value, decimals_for([0.1 * value]), scale.unit)
    return measured(q.estimate, scale, decimals_of([q.estimate], scale.factor))


def _groups(grouped: Sequence[Quantity]) -> list[Block]:
    blocks: list[Block] = []
    for group in dict.fromkeys(q.group for q in grouped):
        chosen = [q for q in grouped if q.group == group]
        keys = list(dict.fromkeys(q.key for q in chosen))
        names = {q.key: q.name for q in chosen}
        rows: list[tuple[Cell, ...]] = []
        for value in dict.fromkeys(q.group_value for q in chosen):
            by_key = {q.key: q for q in chosen if q.group_value == value}
            first = next(iter(by_key.values())).estimate
            cells = [_shown(by_key[key]) if key in by_key else "–" for key in keys]
            rows.append((value, *cells, Number(first.station_count, 0), Number(first.capture_count, 0)))
        words = _GROUP_WORDS.get(group, group.replace("_", " "))
        columns = (
            Column("Group"),
            *(Column(_capital(names[key]), is_numeric=True) for key in keys),
            Column("Places", is_numeric=True),
            Column("Captures", is_numeric=True),
        )
        blocks.append(Table(f"By {words}, with 95 % intervals.", columns, tuple(rows)))
    drawn = [q for q in grouped if q.key == _DRAWN and np.isfinite(q.estimate.value)]
    if drawn:
        blocks.append(_whiskers(drawn))
    return blocks


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _whiskers(drawn: Sequence[Quantity]) -> Figure:
    scale = _scale(drawn[0])
    estimates = [q.estimate.scaled(scale.factor) for q in drawn]
    value, low = np.array([e.value for e in estimates]), np.array([e.low for e in estimates])
    high = np.array([e.high for e in estimates])
    worst = int(np.argmax(value))
    is_open = ~np.isfinite(high)
    reach = 1.1 * max(float(value.max()), float(high[~is_open].max(initial=0.0)))
    key = "by-group"
    alt = (
        f"Position error, RMS, in {len(drawn)} groups of captures with 95 % intervals: from {value.min():.3g} to "
        f"{value.max():.3g} {scale.unit}, largest at {_GROUP_WORDS.get(drawn[worst].group, drawn[worst].group)} "
        f"{drawn[worst].group_value}; {int(is_open.sum())} intervals are open."
    )
    with style(key):
        names = [f"{q.group.replace('_', ' ')}: {q.group_value}" for q in drawn]
        figure, axes = plain_axes(0.9 + 0.24 * len(drawn), names)
        rows = np.arange(len(drawn))
        ends = np.stack([np.maximum(low, 0.0), np.where(is_open, reach, high)], axis=1)
        for row, (left, right) in zip(rows, ends, strict=True):
            axes.plot([left, right], [row, row], "--" if is_open[row] else "-", color=FAINT, lw=1.4)
        axes.plot(value, rows, "o", color=SERIES[0], ms=4.5)
        axes.set_yticks(rows, names)
        axes.set_ylim(len(drawn) - 0.4, -0.6)
        axes.set_xlim(0.0, reach if reach > 0.0 else 1.0)
        axes.set_xlabel(f"position error, RMS ({scale.unit})")
        svg = svg_of(figure, key, alt)
    data = (series("RMS", scale.unit, value), series("low", scale.unit, low), series("high", scale.unit, high))
    caption = "Position error, RMS, of groups of captures with 95 % intervals; dashed: the data cannot bound it."
    return Figure(key, svg, alt, caption, data)
