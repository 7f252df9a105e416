"""Expected deviations and the safety of labels over range and tilt, the worst side of each tilt."""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.beacon_evidence import ForecastEvidence
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Block, Column, Figure, Paragraph, Section, Table
from uvgs_bench.report.figures import canvas, legend_above, series, style, svg_of
from uvgs_bench.report.palette import MARKERS, SERIES
from uvgs_bench.units import deg_from_rad, mm_from_m

_MOVES = 8
_PERCENT = 100.0


def build(evidence: ForecastEvidence) -> Section | None:
    """Findings, maps, sizes, what moving an LED would bring."""
    found = evidence.found
    rows: list[tuple[Cell, ...]] = [(f"Finding {i + 1}", line) for i, line in enumerate(evidence.lines)]
    rows += [(warning.kind, warning.text) for warning in evidence.warnings]
    text = (
        f"The beacon stands in the middle of the picture; centroids err by {evidence.sigma_px:g} px per axis. Each "
        "cell is the worst of the sides the beacon may be tilted to; an empty cell shows fewer than four LEDs."
    )
    # Over azimuths; what nothing is seen of stays NaN.
    position: FloatArray = np.fmax.reduce(mm_from_m(found.position_sigma_m), axis=2)
    attitude: FloatArray = np.fmax.reduce(deg_from_rad(found.attitude_sigma_rad), axis=2)
    margin: FloatArray = np.fmin.reduce(found.margin_px, axis=2)
    blocks: list[Block] = [
        Table("What was found.", (Column("What"), Column("In words")), tuple(rows)),
        Paragraph(text),
        _map(evidence, "forecast-position", position, "mm", "Position, 1 sigma, all axes"),
        _map(evidence, "forecast-attitude", attitude, "deg", "Attitude, 1 sigma, all axes"),
        _map(evidence, "forecast-margin", margin, "px", "Nearest other labels, RMS residual"),
        _sizes(evidence),
    ]
    if evidence.gains:
        blocks.append(_moves(evidence))
    return Section("forecast", "Forecast", tuple(blocks))


def _map(evidence: ForecastEvidence, key: str, values: FloatArray, unit: str, words: str) -> Figure:
    found = evidence.found
    tilts = [f"{deg_from_rad(float(tilt)):.0f}" for tilt in found.tilt_rad]
    ranges = [f"{r:.2f}" for r in found.range_m]
    best, worst = float(np.nanmin(values)), float(np.nanmax(values))
    blind = int(np.isnan(values).sum())
    alt = (
        f"{words}, by range {ranges[0]} to {ranges[-1]} m and tilt {tilts[0]} to {tilts[-1]} deg: {best:.3g} to "
        f"{worst:.3g} {unit}; {blind} of {values.size} cells show fewer than four LEDs."
    )
    with style(key):
        figure = canvas(0.42 * len(ranges) + 1.1)
        axes = figure.add_subplot()
        shown = np.log10(np.maximum(np.ma.masked_invalid(values), 1e-9))
        axes.pcolormesh(shown, cmap="cividis", edgecolors="none")
        middle = 0.5 * (float(shown.min()) + float(shown.max())) + 0.1 * float(np.ptp(shown))
        for (k, i), value in np.ndenumerate(values):
            if np.isfinite(value):
                colour = "#ffffff" if np.log10(max(value, 1e-9)) < middle else "#000000"
                axes.text(
                    i + 0.5,
                    k + 0.5,
                    f"{value:.3g}",
                    ha="center",
                    va="center",
                    in_layout=False,
                    fontsize=7.5,
                    color=colour,
                )
        axes.set_xticks(np.arange(len(tilts)) + 0.5, tilts)
        axes.set_yticks(np.arange(len(ranges)) + 0.5, ranges)
        axes.tick_params(length=0)
        axes.grid(False)
        axes.set_xlabel("tilt (deg)")
        axes.set_ylabel("range (m)")
        svg = svg_of(figure, key, alt)
    numbers = tuple(series(f"{r} m", unit, row) for r, row in zip(ranges, values, strict=True))
    return Figure(key, svg, alt, f"{words}, {unit}, worst side.", numbers)


def _sizes(evidence: ForecastEvidence) -> Figure:
    found = evidence.found
    flat = found.separation_px.reshape(len(found.range_m), -1)
    nearest = np.array([np.nanmin(row) if np.isfinite(row).any() else np.nan for row in flat])
    key = "forecast-sizes"
    known = np.isfinite(found.diameter_px).any()
    size = (
        f"LED diameter {found.diameter_px[0]:.2g} to {found.diameter_px[-1]:.2g} px" if known else "no diameter stated"
    )
    least = float(np.nanmin(nearest)) if np.isfinite(nearest).any() else 0.0
    alt = (
        f"Least distance of two LEDs in the picture, worst view, and size of an LED from {found.range_m[0]:.2g} to "
        f"{found.range_m[-1]:.2g} m: least distance {least:.3g} px; {size}."
    )
    with style(key):
        figure = canvas(0.42 * len(found.range_m) + 1.1)
        axes = figure.add_subplot()
        axes.loglog(found.range_m, nearest, "-", marker=MARKERS[0], color=SERIES[0], ms=5, label="nearest two LEDs")
        if known:
            axes.loglog(
                found.range_m, found.diameter_px, "--", marker=MARKERS[1], color=SERIES[1], ms=5, label="LED, no blur"
            )
        axes.set_xlabel("range (m)")
        axes.set_ylabel("px")
        axes.set_xticks(found.range_m, [f"{r:.2g}" for r in found.range_m])
        axes.xaxis.set_minor_formatter("")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    numbers = (
        series("range", "m", found.range_m),
        series("nearest two LEDs", "px", nearest),
        series("LED diameter", "px", found.diameter_px),
    )
    return Figure(key, svg, alt, "Size and overlap in the picture; blur adds some 3 px to each LED.", numbers)


def _moves(evidence: ForecastEvidence) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (
            f"{gain.led} along {gain.direction}",
            Number(_PERCENT * (gain.attitude_ratio - 1.0), 1),
            Number(_PERCENT * (gain.position_ratio - 1.0), 1),
            Number(gain.margin_px, 2),
        )
        for gain in evidence.gains[:_MOVES]
    ]
    columns = (
        Column(f"LED moved by {mm_from_m(evidence.step_m):g} mm"),
        Column("Attitude deviation", "%", True),
        Column("Position deviation", "%", True),
        Column("Least margin then", "px", True),
    )
    return Table("What moving one LED would change at the middle range, the best first.", columns, tuple(rows))
