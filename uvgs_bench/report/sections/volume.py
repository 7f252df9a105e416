"""The stations in space with their error vectors."""

from __future__ import annotations

import math

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.document import Figure, Section, Series
from uvgs_bench.report.figures import canvas, in_space, legend_above, series, space_axes, style, svg_of
from uvgs_bench.report.palette import FAINT, ORANGE, SERIES
from uvgs_bench.report.quantities import station_means
from uvgs_bench.store.run import Run
from uvgs_bench.units import mm_from_m

_ARROW_SHARE = 0.18
_FORWARD = 2
_AXES = ("x, right (m)", "y, down (m)", "z, forward (m)")


def build(run: Run, judgement: Judgement) -> Section | None:
    """Where the stations were and which way each mean error points."""
    del run
    table = judgement.table
    if table is None or not table.is_solved.any():
        return None
    table = table.select(table.is_solved)
    places = station_means(table.station, table.predicted_t_m)
    errors = station_means(table.station, table.translation_error_m)
    fitted = np.empty((0, 3))
    if judgement.in_sample_table is not None:
        fitted = station_means(judgement.in_sample_table.station, judgement.in_sample_table.predicted_t_m)
    everything = np.vstack([places, fitted])
    extent = float(np.linalg.norm(np.ptp(everything, axis=0)))
    longest = float(np.linalg.norm(errors, axis=1).max())
    # Many stations lie close together: their arrows must stay short to be told apart.
    share = min(_ARROW_SHARE, 0.8 / np.cbrt(len(places)))
    magnification = _rounded_down(share * extent / longest) if longest > 0.0 and extent > 0.0 else 1.0
    figures = (
        _view_3d(places, errors, fitted, magnification),
        _plane(places, errors, magnification, "volume-front", (0, 1), "Seen along the optical axis"),
        _plane(places, errors, magnification, "volume-side", (2, 1), "Seen from the side"),
        _plane(places, errors, magnification, "volume-top", (0, 2), "Seen from above"),
    )
    return Section("volume", "Error vectors over the volume", figures)


def _rounded_down(value: float) -> float:
    """One significant digit, so that readers can divide in their heads."""
    power = 10.0 ** math.floor(math.log10(value))
    return math.floor(value / power) * power


def _data(places: FloatArray, errors: FloatArray) -> tuple[Series, ...]:
    names = ("x", "y", "z")
    return (
        *(series(f"station {n}", "m", places[:, k]) for k, n in enumerate(names)),
        *(series(f"mean error {n}", "mm", mm_from_m(errors[:, k])) for k, n in enumerate(names)),
    )


def _view_3d(places: FloatArray, errors: FloatArray, fitted: FloatArray, magnification: float) -> Figure:
    length_mm = mm_from_m(np.linalg.norm(errors, axis=1))
    worst = int(np.argmax(length_mm))
    mean = mm_from_m(errors.mean(axis=0))
    key = "volume-3d"
    place = places[worst]
    alt = (
        f"{len(places)} held-out stations in the camera frame with their mean error vectors, {magnification:g} times "
        f"as long as true. Longest {length_mm[worst]:.3g} mm at x {place[0]:.3f} m, y {place[1]:.3f} m, "
        f"z {place[2]:.3f} m; mean vector x {mean[0]:+.3g} mm, y {mean[1]:+.3g} mm, z {mean[2]:+.3g} mm."
    )
    with style(key):
        figure = canvas(height_in=3.9, arranges_itself=False)
        ends = np.stack([places, places + magnification * errors], axis=1)
        axes = space_axes(figure, np.vstack([ends.reshape(-1, 3), fitted]))
        for cloud, colour, marker, label in (
            (fitted, FAINT, "x", "registration stations"),
            (places, SERIES[0], "o", "held-out stations"),
        ):
            if len(cloud):
                axes.plot(*in_space(cloud).T, marker, color=colour, ms=3.5, label=label)
        # One line with gaps draws a thousand vectors as fast as one.
        gaps = np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1).reshape(-1, 3)
        axes.plot(*in_space(gaps).T, "-", color=ORANGE, lw=1.3, label=f"mean error × {magnification:g}")
        figure.legend(loc="upper left", ncols=3, handletextpad=0.3, columnspacing=0.9, borderaxespad=0.2)
        svg = svg_of(figure, key, alt)
    caption = f"Stations in the camera frame with their mean error vectors, {magnification:g} times as long as true."
    data = (
        *_data(places, errors),
        *(series(f"registered at {n}", "m", fitted[:, k]) for k, n in enumerate("xyz")),
        series("length drawn", "1", [magnification]),
    )
    return Figure(key, svg, alt, caption, data, live="space")


def _plane(
    places: FloatArray,
    errors: FloatArray,
    magnification: float,
    key: str,
    pair: tuple[int, int],
    view: str,
) -> Figure:
    a, b = pair
    labels = (_AXES[a], _AXES[b])
    in_plane_mm = mm_from_m(np.hypot(errors[:, a], errors[:, b]))
    alt = (
        f"{view}: mean errors of {len(places)} held-out stations in the plane of {labels[0]} and {labels[1]}, "
        f"{magnification:g} times as long as true; median {np.median(in_plane_mm):.3g} mm, longest "
        f"{in_plane_mm.max():.3g} mm."
    )
    with style(key):
        figure = canvas(height_in=3.6)
        axes = figure.add_subplot()
        axes.plot(places[:, a], places[:, b], "o", color=SERIES[0], ms=3.5, label="held-out stations")
        arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.005, "headwidth": 4.0}
        shift = errors * magnification
        axes.quiver(places[:, a], places[:, b], shift[:, a], shift[:, b], color=ORANGE, zorder=3, **arrows)
        # The arrows take part in the limits too.
        axes.update_datalim(np.vstack([places, places + shift])[:, list(pair)])
        axes.margins(0.08)
        axes.autoscale_view()
        axes.set_aspect("equal", adjustable="datalim")
        if b != _FORWARD:
            axes.invert_yaxis()
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        legend_above(axes, 1)
        svg = svg_of(figure, key, alt)
    return Figure(key, svg, alt, f"{view}: mean errors × {magnification:g}.")
