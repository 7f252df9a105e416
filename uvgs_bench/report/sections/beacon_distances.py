"""Distances between the LEDs of a measured beacon: they do not depend on any frame."""

from __future__ import annotations

import numpy as np

from uvgs_bench.report.beacon_evidence import MeasurementEvidence
from uvgs_bench.report.cells import Cell, Number, decimals_for
from uvgs_bench.report.document import Column, Figure, Section, Table
from uvgs_bench.report.figures import canvas, label_of, legend_above, series, style, svg_of
from uvgs_bench.report.palette import BLUE, FAINT, ORANGE
from uvgs_bench.units import mm_from_m

_NORMAL_95 = 1.96


def build(evidence: MeasurementEvidence) -> Section | None:
    """Table and drawing of all pairs."""
    return Section("distances", "Distances", (_table(evidence), _drawing(evidence)))


def _table(evidence: MeasurementEvidence) -> Table:
    distances = evidence.measurement.distances
    decimals = decimals_for([mm_from_m(d.sigma_m) for d in distances], default=3)
    rows: list[tuple[Cell, ...]] = []
    for d in distances:
        off = d.distance_m - d.nominal_m
        by_hand = None if d.caliper_m is None else mm_from_m(d.distance_m - d.caliper_m)
        hand_sigma = None if d.caliper_sigma_m is None else mm_from_m(d.caliper_sigma_m)
        rows.append(
            (
                f"{d.first} to {d.second}",
                Number(mm_from_m(d.distance_m), decimals),
                Number(mm_from_m(d.sigma_m), decimals + 1),
                Number(mm_from_m(d.nominal_m), decimals),
                Number(mm_from_m(off), decimals),
                Number(by_hand, decimals),
                Number(hand_sigma, 3),
            )
        )
    columns = (
        Column("LEDs"),
        Column("Distance", "mm", True),
        Column("1 sigma", "mm", True),
        Column("Nominal", "mm", True),
        Column("Minus nominal", "mm", True),
        Column("Minus caliper", "mm", True),
        Column("Caliper, 1 sigma", "mm", True),
    )
    caption = f"All pairs. Scale: {evidence.measurement.scale_source}."
    return Table(caption, columns, tuple(rows))


def _drawing(evidence: MeasurementEvidence) -> Figure:
    distances = evidence.measurement.distances
    off_mm = np.array([mm_from_m(d.distance_m - d.nominal_m) for d in distances])
    half_mm = np.array([_NORMAL_95 * mm_from_m(d.sigma_m) for d in distances])
    names = [f"{label_of(d.first, 10)} – {label_of(d.second, 10)}" for d in distances]
    at = np.arange(len(distances), dtype=np.float64)
    key = "distances-off"
    worst = int(np.argmax(np.abs(off_mm)))
    outside = int((np.abs(off_mm) > half_mm).sum())
    alt = (
        f"Measured minus nominal distance of {len(distances)} pairs with 95 % intervals; largest {off_mm[worst]:+.3f} "
        f"mm ({distances[worst].first} to {distances[worst].second}); {outside} intervals leave out zero."
    )
    with style(key):
        figure = canvas(max(2.4, 0.34 * len(distances) + 1.1))
        axes = figure.add_subplot()
        axes.axvline(0.0, color=FAINT, lw=1.0)
        axes.errorbar(off_mm, at, xerr=half_mm, fmt="o", color=BLUE, ms=5, capsize=3, label="minus nominal, 95 %")
        hand = [(d.distance_m - d.caliper_m, i) for i, d in enumerate(distances) if d.caliper_m is not None]
        if hand:
            values = [mm_from_m(value) for value, _ in hand]
            axes.plot(values, [i + 0.22 for _, i in hand], "^", color=ORANGE, ms=5, label="minus caliper")
        axes.set_yticks(at, names)
        axes.invert_yaxis()
        axes.set_xlabel("measured minus reference (mm)")
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    numbers = (series("minus nominal", "mm", off_mm), series("half of the 95 % interval", "mm", half_mm))
    return Figure(key, svg, alt, "Measured distances against the nominal ones, with 95 % intervals.", numbers)
