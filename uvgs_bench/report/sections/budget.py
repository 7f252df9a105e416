"""The uncertainty budget: what the errors should amount to, line by line, and what to improve first."""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.uncertainty import Budget, BudgetLine
from uvgs_bench.report.cells import Cell, Interval, Number, decimals_for
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Figure, Level, Paragraph, Section, Table
from uvgs_bench.report.figures import plain_axes, series, style, svg_of
from uvgs_bench.report.palette import FAINT, ORANGE, SERIES
from uvgs_bench.report.quantities import SCALES
from uvgs_bench.store.run import Run

_MM, _DEG = SCALES["m"], SCALES["rad"]


def build(run: Run, judgement: Judgement) -> Section | None:
    """Lines, their sum, a drawing and advice."""
    del run
    budget = judgement.budget
    if budget is None:
        return None
    text = (
        "What one error of the sensor against the registered gantry should amount to, put together from its known "
        "causes (GUM) and drawn at random for comparison (Monte Carlo). Lines of the reference say how far the gantry "
        "itself can be trusted; type A is known from the scatter of these data, type B from elsewhere. A line that "
        "is common is the same in every capture: averaging does not make it smaller."
    )
    blocks: list[Block] = [Paragraph(text), _lines_table(budget), _bars(budget), _sum_table(budget)]
    origins = tuple((line.name, line.source, line.improve) for line in budget.lines)
    words = (Column("Line"), Column("Known from"), Column("Made smaller by"))
    blocks.append(Table("Where each line is known from, and what would make it smaller.", words, origins))
    if budget.advice:
        level: Level = "info"
        blocks.append(Alerts(tuple(Alert(level, advice) for advice in budget.advice)))
    return Section("budget", "Uncertainty budget", tuple(blocks))


def _decimals(largest: float) -> int:
    return decimals_for([0.1 * largest])


def _lines_table(budget: Budget) -> Table:
    mm, deg = _MM.factor * budget.combined_position_m, _DEG.factor * budget.combined_attitude_rad
    mm_decimals, deg_decimals = _decimals(mm) + 1, _decimals(deg) + 1
    rows: list[tuple[Cell, ...]] = []
    for line in budget.lines:
        known = line.is_known
        rows.append(
            (
                line.name,
                line.part,
                line.kind,
                Number(_MM.factor * line.position_m if known else None, mm_decimals, _MM.unit),
                Number(_DEG.factor * line.attitude_rad if known else None, deg_decimals, _DEG.unit),
                Number(100.0 * _share(line, budget) if known else None, 1, "%"),
                line.distribution if known else "not stated",
                Number(line.degrees_of_freedom if known else None, 0),
                "yes" if line.is_common else "no",
            )
        )
    columns = (
        Column("Line"),
        Column("Part"),
        Column("Type"),
        Column("Position", _MM.unit, True),
        Column("Attitude", _DEG.unit, True),
        Column("Share", "%", True),
        Column("Law"),
        Column("Freedom", is_numeric=True),
        Column("Common"),
    )
    caption = (
        "Standard uncertainty that each line adds to one error; share: of the squared position doubt; freedom: degrees "
        "of freedom. A line not stated adds nothing and is named below."
    )
    return Table(caption, columns, tuple(rows))


def _share(line: BudgetLine, budget: Budget) -> float:
    total = budget.combined_position_m**2
    return line.position_m**2 / total if total > 0.0 else float("nan")


def _sum_table(b: Budget) -> Table:
    mm, deg = _MM.factor, _DEG.factor
    mm_decimals, deg_decimals = _decimals(mm * b.combined_position_m), _decimals(deg * b.combined_attitude_rad)

    def pair(name: str, position_m: float | None, attitude_rad: float | None, meaning: str) -> tuple[Cell, ...]:
        return (
            name,
            Number(None if position_m is None else mm * position_m, mm_decimals, _MM.unit),
            Number(None if attitude_rad is None else deg * attitude_rad, deg_decimals, _DEG.unit),
            meaning,
        )

    agreement = "agrees with the expanded uncertainty to 5 %" if b.is_confirmed else "does NOT agree to 5 %: use this"
    rows: tuple[tuple[Cell, ...], ...] = (
        pair("Combined", b.combined_position_m, b.combined_attitude_rad, "root of the sum of squares of all lines"),
        pair("Of it the reference", b.reference_position_m, b.reference_attitude_rad, "gantry, clock, registration"),
        (
            "Coverage factor k",
            Number(b.coverage_factor, 2),
            Number(b.attitude_coverage_factor, 2),
            f"for the length of a vector, 95 %; {b.degrees_of_freedom:.0f} degrees of freedom"
            if np.isfinite(b.degrees_of_freedom)
            else "for the length of a vector, 95 %",
        ),
        pair("Expanded, k times combined", b.expanded_position_m, b.expanded_attitude_rad, "95 % of errors are below"),
        pair("The same by Monte Carlo", b.monte_carlo_position_m, b.monte_carlo_attitude_rad, agreement),
        (
            "Shortest 95 % interval",
            Interval(mm * b.monte_carlo_low_m, mm * b.monte_carlo_high_m, mm_decimals, _MM.unit),
            "",
            "of the length of the position error, by Monte Carlo",
        ),
        pair("Observed, RMS", b.observed_position_m, b.observed_attitude_rad, "compare with the combined uncertainty"),
    )
    columns = (
        Column("Figure"),
        Column("Position", is_numeric=True),
        Column("Attitude", is_numeric=True),
        Column("Meaning"),
    )
    return Table("The lines put together, and held against what was observed.", columns, rows)


def _bars(budget: Budget) -> Figure:
    known = [line for line in budget.lines if line.is_known]
    size_mm = _MM.factor * np.array([line.position_m for line in known])
    observed_mm, combined_mm = _MM.factor * budget.observed_position_m, _MM.factor * budget.combined_position_m
    key = "budget-bars"
    alt = (
        f"Standard uncertainty of {len(known)} lines of the position error: "
        + ", ".join(f"{line.name} {mm:.2g} mm" for line, mm in zip(known, size_mm, strict=True))
        + f". Together {combined_mm:.3g} mm; observed {observed_mm:.3g} mm RMS."
    )
    with style(key):
        names = [*(line.name for line in known), "combined"]
        figure, axes = plain_axes(1.0 + 0.28 * len(names), names)
        rows = np.arange(len(known) + 1)
        colours = [SERIES[0] if line.part == "sensor" else ORANGE for line in known]
        axes.barh(rows, [*size_mm, combined_mm], color=[*colours, FAINT], height=0.66)
        if np.isfinite(observed_mm):
            axes.axvline(observed_mm, color=FAINT, lw=1.2, ls="--")
            axes.annotate("observed", (observed_mm, -0.62), (3, 0), textcoords="offset points", fontsize=8, va="center")
        axes.set_yticks(rows, names)
        axes.set_ylim(len(known) + 0.5, -0.95)
        axes.set_xlabel("standard uncertainty of one position error (mm)")
        axes.grid(False, axis="y")
        svg = svg_of(figure, key, alt)
    data = (series("lines", "mm", size_mm), series("combined", "mm", [combined_mm]))
    caption = "Lines of the budget: sensor blue, reference orange; dashed: root mean square of the errors observed."
    return Figure(key, svg, alt, caption, data)
