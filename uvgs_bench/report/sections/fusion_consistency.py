"""Whether the stated doubt is the true one: NEES against the truth, NIS of the believed poses."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.navigation.fusion_outcome import FusionOutcome
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import canvas, legend_above, series, style, svg_of, thinned
from uvgs_bench.report.palette import BLUE, FAINT, ORANGE
from uvgs_bench.units import percent_from_fraction

# What is larger is drawn at this, lest one value flatten all others.
_MOST_NEES = 60.0
# 95 % of the chi-square law with 6 and 9 degrees of freedom, two-sided.
_BANDS = {6: (1.2373, 14.4494), 9: (2.7004, 19.0228)}


def build(outcome: FusionOutcome) -> Section | None:
    """A table and a drawing; nothing for poses alone, which state no innovations."""
    score = outcome.main.score
    kinds: list[tuple[str, FloatArray, int]] = [
        (f"NIS of {name}", nis, 6) for name, nis in score.nis.items() if np.isfinite(nis).any()
    ]
    if np.isfinite(score.nees).any():
        kinds.insert(0, ("NEES of position, velocity, rotation", score.nees, 9))
    if not kinds:
        return None
    rows: list[tuple[Cell, ...]] = []
    for name, values, freedom in kinds:
        low, high = _BANDS[freedom]
        inside = float(np.mean((values >= low) & (values <= high)))
        cells = Number(float(np.mean(values)), 1), Number(freedom, 0), Number(percent_from_fraction(inside), 0)
        rows.append((name, *cells))
    columns = (
        Column("What"),
        Column("Mean", "", True),
        Column("Expected", "", True),
        Column("In 95 % band", "%", True),
    )
    text = (
        "Values far above what is expected mean that the fusion is surer than right; far below, that poses or readings "
        "are better than they say. Poses that state what lens and beacon add, which is the same in every capture, make "
        "the NIS lower than expected. Instants of one mission are not independent."
    )
    blocks: list[Block] = [Table("Consistency of the fusion asked for.", columns, tuple(rows)), Paragraph(text)]
    if len(score.nees) > 1 and np.isfinite(score.nees).any():
        blocks.append(_drawing(outcome))
    return Section("consistency", "Consistency", tuple(blocks))


def _drawing(outcome: FusionOutcome) -> Figure:
    key = "fusion-nees"
    score = outcome.main.score
    shown = thinned(len(score.nees))
    low, high = _BANDS[9]
    alt = f"NEES over time: mean {np.mean(score.nees):.1f} where 9 is expected, at most {np.max(score.nees):.0f}."
    with style(key):
        figure = canvas(2.8)
        axes = figure.add_subplot()
        axes.plot(score.t_s[shown], np.minimum(score.nees[shown], _MOST_NEES), ".", color=BLUE, ms=2.4, label="NEES")
        axes.axhline(9.0, color=FAINT, lw=0.9, label="expected")
        for end in (low, high):
            axes.axhline(end, color=ORANGE, lw=0.9, ls="--", label="95 % band" if end == low else "_nolegend_")
        axes.set_xlabel("time (s)")
        axes.set_ylabel("NEES of 9 errors")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    return Figure(
        key, svg, alt, "Squared errors in units of the stated covariance, over time; beyond 60 drawn at 60.",
        (series("time", "s", score.t_s), series("NEES", "", score.nees)),
    )  # fmt: skip
