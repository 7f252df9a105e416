"""Every limit with its figure, interval and verdict, then what the reader must be told first."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.judgement import QUANTITIES, Judgement, LimitVerdict
from uvgs_bench.accuracy.quantity_catalogue import TEXTS
from uvgs_bench.report.cells import Cell, Interval, Mark, Number, decimals_for
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Level, Paragraph, Section, Table
from uvgs_bench.report.quantities import (
    COMPONENT_WORDS,
    STATISTIC_WORDS,
    is_largest_seen,
    limit_reason,
    unit_word,
)
from uvgs_bench.store.run import Run

_LEVELS: dict[str, Level] = {"note": "info", "warning": "warning", "error": "danger"}
# The verdict stands beside its requirement, so that it is seen on a telephone without scrolling.
_COLUMNS = (
    Column("Requirement"),
    Column("Verdict"),
    Column("Found", is_numeric=True),
    Column("95 % interval", is_numeric=True),
    Column("Limit", is_numeric=True),
    Column("Stations", is_numeric=True),
    Column("Because"),
)


def build(run: Run, judgement: Judgement) -> Section | None:
    """The limits and the alerts."""
    del run
    blocks: list[Block] = []
    if judgement.verdicts:
        rows = tuple(_row(verdict) for verdict in judgement.verdicts)
        caption = (
            "A limit is met only when the whole 95 % interval lies within it, and missed only when it lies outside."
        )
        blocks.append(Table(caption, _COLUMNS, rows))
    else:
        blocks.append(Paragraph("The procedure sets no limits, so there is nothing to pass: the verdict stays open."))
    blocks.append(Paragraph(judgement.split))
    if judgement.alerts:
        blocks.append(Alerts(tuple(Alert(_LEVELS[alert.level], alert.text) for alert in judgement.alerts)))
    return Section("limits", "Verdict against the limits", tuple(blocks))


def _row(verdict: LimitVerdict) -> tuple[Cell, ...]:
    limit = verdict.limit
    component, statistic, _ = QUANTITIES[limit.quantity]
    if component == "availability":
        words = STATISTIC_WORDS[statistic]
    elif component == "quantity":
        words = TEXTS[statistic].name
    else:
        words = f"{COMPONENT_WORDS[component].split(',')[0].split(' (')[0]}, {STATISTIC_WORDS[statistic]}"
    unit = unit_word(limit.unit)
    # An open interval says nothing about digits; three of the figure itself are then all that can be defended.
    width = 0.5 * (verdict.high - verdict.low)
    decimals = decimals_for([width if np.isfinite(width) else 0.1 * abs(verdict.value)], default=2)
    if limit.unit == "percent":
        decimals = max(decimals, 1)
    sign = "≤" if limit.bound == "max" else "≥"
    interval: Cell = Interval(verdict.low, verdict.high, decimals, unit)
    return (
        words,
        Mark(verdict.verdict),
        Number(verdict.value, decimals, unit),
        "the largest seen" if is_largest_seen(verdict) else interval,
        f"{sign} {limit.value:g} {unit}",
        Number(verdict.n, 0),
        limit_reason(verdict),
    )
