"""Maps of the error over the volume: how large by colour, which way by arrows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.document import Figure, Paragraph, Section, Series
from uvgs_bench.report.error_colours import BAR_IN, ErrorColours, draw_bar, draw_by_error, error_colours
from uvgs_bench.report.figures import WIDTH_IN, canvas, series, style, svg_of
from uvgs_bench.report.palette import FAINT, INK
from uvgs_bench.report.quantities import station_means
from uvgs_bench.report.space import space_view
from uvgs_bench.store.run import Run
from uvgs_bench.units import deg_from_rad, mm_from_m

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

_ARROW_SHARE = 0.18
_FORWARD = 2
_AXES = ("x, right (m)", "y, down (m)", "z, forward (m)")
_JUDGES, _FITS = "o", "s"
_BAR = "length of the mean position error of a station (mm)"
_LEFT_IN, _RIGHT_IN, _LOWER_IN, _LEGEND_IN = 0.74, 0.15, 0.5, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    """Stations with their mean errors, those that judge first."""

    places: FloatArray
    errors: FloatArray
    turns_deg: FloatArray
    fits: NDArray[np.bool_]
    bands: ErrorColours
    times: float

    @property
    def lengths_mm(self) -> FloatArray:
        lengths: FloatArray = mm_from_m(np.linalg.norm(self.errors, axis=1))
        return lengths


def build(run: Run, judgement: Judgement) -> Section | None:
    """Where the stations were, how far off each was on average, and which way."""
    del run
    table = judgement.table
    if table is None or not table.is_solved.any():
        return None
    shown = _map_of(table, judgement.in_sample_table)
    text = (
        "Each mark is a station, or a capture in motion; its colour and size say how long the mean of its position "
        f"errors is, the line from it which way that mean points, {shown.times:g} times as long as true. Discs judge; "
        "squares fitted the registration, so their errors are flattered. A pattern, not a speckle, points at a cause: "
        "see the diagnosis."
    )
    figures = (
        _view_3d(shown),
        _plane(shown, "volume-front", (0, 1), "Seen along the optical axis"),
        _plane(shown, "volume-side", (2, 1), "Seen from the side"),
        _plane(shown, "volume-top", (0, 2), "Seen from above"),
    )
    return Section("volume", "Error maps over the volume", (Paragraph(text), *figures))


def _map_of(table: ErrorTable, in_sample: ErrorTable | None) -> _Map:
    tables = [table.select(table.is_solved)]
    # Judged by folds, every station does both: it is drawn once, by the errors that count.
    if in_sample is not None and not np.isin(in_sample.station, table.station).any():
        tables.append(in_sample.select(in_sample.is_solved))
    places = np.concatenate([station_means(t.station, t.predicted_t_m) for t in tables])
    errors = np.concatenate([station_means(t.station, t.translation_error_m) for t in tables])
    turns = np.concatenate([station_means(t.station, t.rotation_error_rad) for t in tables])
    judging = len(np.unique(tables[0].station))
    fits = np.arange(len(places)) >= judging
    lengths = np.linalg.norm(errors, axis=1)
    extent, longest = float(np.linalg.norm(np.ptp(places, axis=0))), float(lengths[~fits].max())
    # Many stations lie close together: their arrows must stay short to be told apart.
    share = min(_ARROW_SHARE, 0.8 / np.cbrt(len(places)))
    times = _rounded_down(share * extent / longest) if longest > 0.0 and extent > 0.0 else 1.0
    bands = error_colours(mm_from_m(lengths[~fits]))
    return _Map(places, errors, deg_from_rad(np.linalg.norm(turns, axis=1)), fits, bands, times)


def _rounded_down(value: float) -> float:
    """One significant digit, so that readers can divide in their heads."""
    power = 10.0 ** math.floor(math.log10(value))
    return math.floor(value / power) * power


def _told(shown: _Map) -> str:
    """The message of every map in words."""
    judges = ~shown.fits
    length_mm, places = shown.lengths_mm[judges], shown.places[judges]
    worst = int(np.argmax(length_mm))
    mean = mm_from_m(shown.errors[judges].mean(axis=0))
    place = places[worst]
    return (
        f"{len(places)} held-out stations, mean errors of median {np.median(length_mm):.3g} mm; largest "
        f"{length_mm[worst]:.3g} mm at x {place[0]:.3f} m, y {place[1]:.3f} m, z {place[2]:.3f} m; mean vector "
        f"x {mean[0]:+.3g} mm, y {mean[1]:+.3g} mm, z {mean[2]:+.3g} mm. {int(shown.fits.sum())} stations fitted the "
        "registration."
    )


def _view_3d(shown: _Map) -> Figure:
    key = "volume-3d"
    alt = f"Error map over the volume in the camera frame, by colour and with error vectors. {_told(shown)}"
    ends = np.stack([shown.places, shown.places + shown.times * shown.errors], axis=1)
    with style(key):
        figure, view = space_view(ends.reshape(-1, 3), below_in=BAR_IN)
        view.axes.plot(*view.of(_with_gaps(ends)), "-", color=FAINT, lw=0.9)
        places = view.of(shown.places)
        for chosen, mark in ((shown.fits, _FITS), (~shown.fits, _JUDGES)):
            draw_by_error(view.axes, places[:, chosen], shown.lengths_mm[chosen], shown.bands, mark)
        _legend(figure, shown)
        draw_bar(figure, shown.bands, _BAR)
        svg = svg_of(figure, key, alt)
    caption = f"The volume in the camera frame: errors by colour, and as vectors {shown.times:g} times as long as true."
    return Figure(key, svg, alt, caption, _data(shown), live="space")


def _data(shown: _Map) -> tuple[Series, ...]:
    names = ("x", "y", "z")
    return (
        *(series(f"station {n}", "m", shown.places[:, k]) for k, n in enumerate(names)),
        *(series(f"mean error {n}", "mm", mm_from_m(shown.errors[:, k])) for k, n in enumerate(names)),
        series("angle of the mean attitude error", "deg", shown.turns_deg),
        series("fitted the registration", "1", shown.fits.astype(np.float64)),
        series("length drawn", "1", [shown.times]),
    )


def _plane(shown: _Map, key: str, pair: tuple[int, int], view: str) -> Figure:
    a, b = pair
    labels = (_AXES[a], _AXES[b])
    in_plane_mm = mm_from_m(np.hypot(shown.errors[:, a], shown.errors[:, b]))[~shown.fits]
    alt = (
        f"{view}: mean errors of {len(in_plane_mm)} held-out stations by colour, and as vectors in the plane of "
        f"{labels[0]} and {labels[1]}, {shown.times:g} times as long as true; in this plane median "
        f"{np.median(in_plane_mm):.3g} mm, longest {in_plane_mm.max():.3g} mm."
    )
    ends = np.stack([shown.places, shown.places + shown.times * shown.errors], axis=1)
    height_in = 4.1
    with style(key):
        figure = canvas(height_in, arranges_itself=False)
        lower_in = BAR_IN + _LOWER_IN
        width_in, inner_in = WIDTH_IN - _LEFT_IN - _RIGHT_IN, height_in - lower_in - _LEGEND_IN
        sides = (_LEFT_IN / WIDTH_IN, lower_in / height_in, width_in / WIDTH_IN, inner_in / height_in)
        axes = figure.add_axes(sides)
        lines = _with_gaps(ends)
        axes.plot(lines[:, a], lines[:, b], "-", color=FAINT, lw=0.9)
        for chosen, mark in ((shown.fits, _FITS), (~shown.fits, _JUDGES)):
            draw_by_error(axes, shown.places[chosen][:, pair].T, shown.lengths_mm[chosen], shown.bands, mark)
        axes.margins(0.08)
        axes.autoscale_view()
        axes.set_aspect("equal", adjustable="datalim")
        if b != _FORWARD:
            axes.invert_yaxis()
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        _legend(figure, shown)
        draw_bar(figure, shown.bands, _BAR)
        svg = svg_of(figure, key, alt)
    return Figure(key, svg, alt, f"{view}: errors by colour, vectors × {shown.times:g}.")


def _with_gaps(ends: FloatArray) -> FloatArray:
    """One line with gaps draws a thousand vectors as fast as one."""
    return np.concatenate([ends, np.full((len(ends), 1, 3), np.nan)], axis=1).reshape(-1, 3)


def _legend(figure: Canvas, shown: _Map) -> None:
    from matplotlib.lines import Line2D

    def mark(shape: str, label: str) -> Line2D:
        line = Line2D([], [], marker=shape, label=label, linestyle="none", markersize=5.0)
        line.set(color="none", markeredgecolor=INK)
        return line

    handles = [mark(_JUDGES, "judge")]
    if shown.fits.any():
        handles.append(mark(_FITS, "fitted the registration"))
    handles.append(Line2D([], [], color=FAINT, lw=1.0, label=f"mean error × {shown.times:g}"))
    place: dict[str, Any] = {"loc": "upper left", "ncols": 3, "handletextpad": 0.4, "borderaxespad": 0.2}
    figure.legend(handles=handles, columnspacing=1.2, **place)
