"""Runs side by side as a page: what differed in the set-up, what changed in the figures, and how they wander."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uvgs_bench import __version__
from uvgs_bench.accuracy.comparison import LEVEL, Change
from uvgs_bench.accuracy.iso_figures import Precision
from uvgs_bench.accuracy.statistics import Estimate
from uvgs_bench.report.cells import Cell, Interval, Mark, Measured, Number, State, decimals_for
from uvgs_bench.report.document import (
    Alert,
    Block,
    Column,
    Definitions,
    Document,
    Figure,
    KeyFigure,
    Paragraph,
    Section,
    Table,
)
from uvgs_bench.report.figures import canvas, label_of, series, style, svg_of
from uvgs_bench.report.palette import BLUE, ORANGE
from uvgs_bench.report.quantities import COMPONENT_WORDS, SCALES, decimals_of, measured
from uvgs_bench.store.comparing import ComparedRun, Comparison
from uvgs_bench.units import percent_from_fraction

_LEAST_SHOWN = 1e-4
_STATES: dict[str, State] = {
    "worse": "fail", "better": "pass", "no difference shown": "none", "inconclusive": "inconclusive",
}  # fmt: skip
_STATISTICS = {"rms": "RMS", "p95": "95th percentile", "repeatability": "repeatability (about the place)"}
_SHOWN = (("position", "rms"), ("lateral", "rms"), ("depth", "rms"), ("attitude", "rms"), ("position", "p95"))


def build_comparison_document(comparison: Comparison) -> Document:
    """Build the report of compared runs. It depends on the comparison alone.

    Args:
        comparison: The runs and their changes.

    Returns:
        The document.
    """
    runs = comparison.runs
    state, word, headline = verdict_of(comparison)
    return Document(
        title=f"{len(runs)} runs compared",
        subtitle=f"{runs[0].run.manifest.id} to {runs[-1].run.manifest.id}",
        created_utc="",
        verdict=state,
        headline=headline,
        banners=_banners(comparison),
        key_figures=_key_figures(comparison),
        sections=tuple(s for s in (_setup(runs), _changes(comparison), _figures(comparison), _definitions()) if s),
        provenance=(
            *((f"run {i + 1}", compared.run.manifest.id) for i, compared in enumerate(runs)),
            ("compared with", f"the {comparison.baseline} run"),
            ("report made by", f"uvgs_bench {__version__}"),
        ),
        genre="comparison report",
        subject="comparison",
        verdict_word=word,
    )


def verdict_of(comparison: Comparison) -> tuple[State, str, str]:
    """State, word and sentence of a whole comparison."""
    changes = [(i, c) for i, compared in enumerate(comparison.runs) for c in compared.changes]
    worse = [(i, c) for i, c in changes if c.word == "worse"]
    if worse:
        said = "; ".join(f"{change_words(c)} of run {i + 1} {effect_words(c)}" for i, c in worse)
        return "fail", "worse", f"Worse: {said}."
    if any(c.word == "inconclusive" for _, c in changes):
        why = next(c.note for _, c in changes if c.word == "inconclusive")
        return "inconclusive", "inconclusive", f"Not every figure can be compared: {why}."
    seen = [c for _, c in changes if c.key == "position_rms"]
    least = max((c.seen for c in seen), default=float("inf"))
    hint = f"a change of position RMS of {percent_from_fraction(least - 1.0):.0f} % or more would have been seen"
    better = [(i, c) for i, c in changes if c.word == "better"]
    if better:
        said = "; ".join(f"{change_words(c)} of run {i + 1} {effect_words(c)}" for i, c in better)
        return "pass", "better", f"Nothing is worse; {hint}. Better: {said}."
    return "none", "no difference shown", f"No figure is shown to have changed; {hint}."


def change_words(change: Change) -> str:
    """The figure in words."""
    if change.key == "availability":
        return "availability"
    component, statistic = change.key.rsplit("_", 1)
    return f"{component} {_STATISTICS[statistic]}"


def effect_words(change: Change) -> str:
    """What became of the figure: ``is 1.4 times that of before (1.2 to 1.7)``."""
    if change.unit == "percent":
        low, mid, high = (percent_from_fraction(v) for v in (change.low, change.change, change.high))
        return f"changed by {mid:.1f} percentage points ({low:.1f} to {high:.1f})"
    return f"is {change.change:.2f} times the earlier ({change.low:.2f} to {change.high:.2f})"


def _banners(comparison: Comparison) -> tuple[Alert, ...]:
    banners: list[Alert] = []
    kinds = {compared.run.manifest.simulated for compared in comparison.runs}
    if kinds == {True}:
        banners.append(Alert("warning", "SIMULATED BENCH. These figures say nothing about a real sensor."))
    elif len(kinds) == 2:
        banners.append(Alert("danger", "SIMULATED AND REAL RUNS are compared here: a change may be the simulation's."))
    for i, compared in enumerate(comparison.runs):
        if not compared.run.is_complete:
            banners.append(Alert("warning", f"Run {i + 1} did not reach its end; it is compared on what there is."))
    return tuple(banners)


def _key_figures(comparison: Comparison) -> tuple[KeyFigure, ...]:
    figures = []
    for change in comparison.runs[-1].changes:
        if change.key in ("position_rms", "depth_rms", "attitude_rms"):
            interval = Interval(change.low, change.high, 2, "times")
            label = f"Last run, {change_words(change)}"
            figures.append(KeyFigure(label, Number(change.change, 2, "times"), interval, change.word))
    return tuple(figures)


def _setup(runs: Sequence[ComparedRun]) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for i, compared in enumerate(runs[1:], start=2):
        rows += [(f"{i} against {compared.against + 1}", name, there, here) for name, there, here in compared.setup]
    blocks: list[Block] = [
        Table(
            "The runs, by date.",
            (Column("Run"), Column("Name"), Column("Begun (UTC)"), Column("End"), Column("Captures", is_numeric=True)),
            tuple(
                (str(i), c.run.manifest.id, c.run.manifest.created_utc, c.run.ended or "no recorded end",
                 Number(len(c.run.samples), 0))
                for i, c in enumerate(runs, start=1)
            ),
        )
    ]  # fmt: skip
    if rows:
        columns = (Column("Runs"), Column("What"), Column("There"), Column("Here"))
        blocks.append(
            Table("What was not the same. A change of a figure may be a change of these.", columns, tuple(rows))
        )
    else:
        blocks.append(Paragraph("Set-up files, plan, controller and versions are the same in all of them."))
    return Section("runs", "The runs and what differs between them", tuple(blocks))


def _changes(comparison: Comparison) -> Section:
    blocks: list[Block] = []
    for i, compared in enumerate(comparison.runs):
        if not compared.changes:
            continue
        rows: list[tuple[Cell, ...]] = [_row(change) for change in compared.changes]
        how = "each place with itself" if compared.is_paired else "as independent runs: their places differ"
        caption = f"Run {i + 1} against run {compared.against + 1}, {compared.changes[0].places} places, {how}."
        columns = (
            Column("Figure"), Column("Verdict"), Column(f"Run {compared.against + 1}", is_numeric=True),
            Column(f"Run {i + 1}", is_numeric=True), Column("Change, 95 %", is_numeric=True),
            Column("Would have been seen", is_numeric=True), Column("p, adjusted", is_numeric=True),
        )  # fmt: skip
        blocks.append(Table(caption, columns, tuple(rows)))
    if comparison.allowed > 0.0:
        allowed = percent_from_fraction(comparison.allowed)
        blocks.append(Paragraph(f"A figure counts as worse only when it is worse by more than {allowed:g} %."))
    return Section("changes", "What changed", tuple(blocks))


def _row(change: Change) -> tuple[Cell, ...]:
    verdict = Mark(_STATES[change.word], change.word)
    p: Cell = f"< {_LEAST_SHOWN:g}" if change.adjusted_p < _LEAST_SHOWN else Number(change.adjusted_p, 4)
    return change_words(change), verdict, *_values(change), _effect(change), _seen(change), p


def _values(change: Change) -> tuple[Number, Number]:
    scale = SCALES[change.unit]
    values = [scale.factor * change.first, scale.factor * change.second]
    digits = 1 if change.unit == "percent" else decimals_for([0.1 * v for v in values])
    return Number(values[0], digits, scale.unit), Number(values[1], digits, scale.unit)


def _effect(change: Change) -> Measured:
    if change.unit == "percent":
        low, mid, high = (percent_from_fraction(v) for v in (change.low, change.change, change.high))
        return Measured(Number(mid, 1, "points"), Interval(low, high, 1, "points"))
    return Measured(Number(change.change, 2, "times"), Interval(change.low, change.high, 2, "times"))


def _seen(change: Change) -> Number:
    if change.unit == "percent":
        return Number(percent_from_fraction(change.seen), 1, "points")
    return Number(change.seen, 2, "times")


def _figures(comparison: Comparison) -> Section:
    summaries = [compared.judgement.summary for compared in comparison.runs]
    columns = [Column("Run")]
    by_figure: list[list[Estimate]] = []
    for component, statistic in _SHOWN:
        estimates = [getattr(s.components[component], statistic) for s in summaries if s is not None]
        if len(estimates) == len(summaries):
            by_figure.append(estimates)
            unit = SCALES["rad" if component == "attitude" else "m"].unit
            word = f"{COMPONENT_WORDS.get(component, component)}, {_STATISTICS[statistic]}"
            columns.append(Column(word, unit, is_numeric=True))
    rows: list[tuple[Cell, ...]] = []
    for i in range(len(summaries)):
        cells: list[Cell] = [str(i + 1)]
        for (component, _), estimates in zip(_SHOWN, by_figure, strict=False):
            scale = SCALES["rad" if component == "attitude" else "m"]
            cells.append(measured(estimates[i], scale, decimals_of(estimates, scale.factor)))
        rows.append(tuple(cells))
    blocks: list[Block] = [Table("Every run by itself, with 95 % intervals.", tuple(columns), tuple(rows))]
    if by_figure:
        blocks.append(_trend_figure(by_figure[0], "position", "trend-position"))
        blocks.append(_trend_figure(by_figure[3], "attitude", "trend-attitude"))
    if comparison.precision is not None:
        blocks.append(_precision_table(comparison.precision))
    for trend in comparison.trends:
        low, mid, high = (percent_from_fraction(v) for v in (trend.low, trend.per_day, trend.high))
        is_shown = trend.low > 0.0 or trend.high < 0.0
        said = "a trend is shown" if is_shown else "no trend is shown"
        component = trend.key.rsplit("_", 1)[0]
        digits = decimals_for([0.5 * (high - low)], default=1)
        per_day, ends = f"{mid:.{digits}f} % per day", f"95 %: {low:.{digits}f} to {high:.{digits}f}"
        text = f"Over time {component} RMS changes by {per_day} ({ends}): {said}."
        blocks.append(Paragraph(text))
    return Section("figures", "The runs side by side", tuple(blocks))


def _precision_table(found: Precision) -> Table:
    r, R = found.limits
    named = {
        "Repeatability standard deviation s_r, within a run": found.within,
        "Between-run standard deviation s_L": found.between,
        "Reproducibility standard deviation s_R": found.total,
        "Repeatability limit r": r,
        "Reproducibility limit R": R,
    }
    scale = SCALES["m"]
    rows: list[tuple[Cell, ...]] = [
        (name, measured(e, scale, decimals_of([e], scale.factor)), e.note) for name, e in named.items()
    ]
    columns = (Column("Figure"), Column("Per axis", is_numeric=True), Column("Note"))
    caption = "Repeatability and reproducibility of the position over these runs of the same places, after ISO 5725-2."
    return Table(caption, columns, tuple(rows))


def _trend_figure(estimates: Sequence[Estimate], component: str, key: str) -> Figure:
    scale = SCALES["rad" if component == "attitude" else "m"]
    values = np.array([e.value * scale.factor for e in estimates])
    low = np.array([e.low * scale.factor for e in estimates])
    high = np.array([e.high * scale.factor for e in estimates])
    number = np.arange(1, len(values) + 1)
    told = ", ".join(f"run {i}: {v:.3g}" for i, v in zip(number, values, strict=True))
    alt = f"RMS {component} error of each run in {scale.unit}, with 95 % intervals: {told}."
    with style(key):
        figure = canvas(2.6)
        axes: Any = figure.add_subplot()
        # An open interval ends at the edge of the drawing.
        top = 1.15 * float(np.max(np.where(np.isfinite(high), high, values)))
        ends = np.where(np.isfinite(high), high, top)
        axes.vlines(number, low, ends, color=BLUE, linewidth=1.6)
        axes.plot(number, values, "o", color=ORANGE, markersize=5.5)
        axes.set_xticks(number, [label_of(str(i)) for i in number])
        axes.set_xlim(0.5, len(values) + 0.5)
        axes.set_ylim(0.0, top)
        axes.set_xlabel("run, by date")
        axes.set_ylabel(f"{component} RMS ({scale.unit})")
        svg = svg_of(figure, key, alt)
    numbers = (
        series("run", "", number.astype(float)),
        series("RMS", scale.unit, values),
        series("low", scale.unit, low),
        series("high", scale.unit, high),
    )
    return Figure(key, svg, alt, f"{component.capitalize()} error of each run, RMS with 95 % interval.", numbers)


def _definitions() -> Section:
    items = (
        ("Change", "The figure of this run over that of the run it is compared with; for availability the difference."),
        (
            "Interval",
            "From the influence of every place on the figure, and from both registrations' doubt. Where both runs "
            "visited the same places each is compared with itself.",
        ),
        (
            "p, adjusted",
            "Chance of a change this large by luck, raised by Holm's method for the number of figures looked at: a "
            f"verdict of worse or better anywhere on this page is false in at most {LEVEL:.0%} of such pages.",
        ),
        ("Would have been seen", "A change beyond this would have put its interval off 'no change'."),
        (
            "Limits r and R",
            "2.8 times s_r and s_R: two captures of a place, in one run or in two, differ by less in 95 of 100 cases. "
            "Each run is about its own registration, so a shift common to all places of a run is not in them.",
        ),
        ("Repeatability", "RMS of the captures about the mean of their place."),
    )
    return Section("definitions", "Definitions", (Definitions(items),))
