"""Errors against range, angles, station position and time, drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.devices.gantry.axes import Axis
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.document import Block, Figure, Paragraph, Section
from uvgs_bench.report.figures import legend_above, plain_axes, series, style, svg_of, symmetric_limits, thinned
from uvgs_bench.report.marks import draw_marks
from uvgs_bench.report.palette import FAINT, MARKERS, SERIES
from uvgs_bench.store.run import Run
from uvgs_bench.units import deg_from_rad, mm_from_m, s_from_ns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POSITION = ("lateral x", "lateral y", "depth z")
_ATTITUDE = ("tilt x", "tilt y", "roll z")


def build(run: Run, judgement: Judgement) -> Section | None:
    """Figures of the error against everything it may depend on."""
    table = judgement.table
    if table is None or not table.is_solved.any():
        return None
    table = table.select(table.is_solved)
    position_mm, attitude_deg = mm_from_m(table.translation_error_m), deg_from_rad(table.rotation_error_rad)
    blocks: list[Block] = [
        Paragraph("One mark per held-out capture. A straight slope against range or position points at a scale error.")
    ]
    off_axis_deg = deg_from_rad(table.field_angle_rad)
    # A beacon shows the same face along its axis whichever way the axis is told to point.
    turned_deg = deg_from_rad(np.minimum(table.view_angle_rad, np.pi - table.view_angle_rad))
    distance = _Abscissa("range", "m", "range to the beacon (m)", table.range_m)
    off_axis = _Abscissa("off-axis", "deg", "angle off the optical axis (deg)", off_axis_deg)
    turned = _Abscissa("view", "deg", "angle between beacon axis and line of sight (deg)", turned_deg)
    blocks += [
        _against(distance, position_mm, _POSITION, "position error", "mm"),
        _against(distance, attitude_deg, _ATTITUDE, "attitude error", "deg"),
        _against(off_axis, position_mm, _POSITION, "position error", "mm"),
        _against(turned, attitude_deg, _ATTITUDE, "attitude error", "deg"),
    ]
    blocks.extend(_against_axis(table, position_mm, i, axis) for i, axis in enumerate(run.manifest.axes))
    blocks.append(_against_time(run, table, judgement.in_sample_table))
    return Section("errors", "Errors against range, angle, position and time", tuple(blocks))


def _scatter(axes: Axes, x: FloatArray, errors: FloatArray, names: tuple[str, ...]) -> None:
    for k, name in enumerate(names):
        draw_marks(axes, np.stack([x, errors[:, k]]), MARKERS[k], colour=SERIES[k], alpha=0.75, label=name)
    axes.axhline(0.0, color=FAINT, lw=0.8)
    symmetric_limits(axes, errors)


@dataclass(frozen=True, slots=True, eq=False)
class _Abscissa:
    """What errors are drawn against: short name, unit, words of the axis, values (N,)."""

    name: str
    unit: str
    words: str
    values: FloatArray


def _against(x: _Abscissa, errors: FloatArray, names: tuple[str, ...], what: str, unit: str) -> Figure:
    has_extent = float(np.ptp(x.values)) > 1e-6
    slope = np.polyfit(x.values, errors, 1)[0] if has_extent else np.zeros(3)
    largest = np.abs(errors).max(axis=0)
    key = f"{x.name}-{what.split()[0]}"
    of = x.words.rpartition(" (")[0]
    alt = (
        f"Components of the {what} against {of} from {x.values.min():.3f} {x.unit} to {x.values.max():.3f} {x.unit}. "
        + "; ".join(
            f"{n}: largest {largest[k]:.3g} {unit}, slope {slope[k]:+.3g} {unit} per {x.unit}"
            for k, n in enumerate(names)
        )
        + "."
    )
    with style(key):
        figure, axes = plain_axes()
        shown = thinned(len(x.values))
        _scatter(axes, x.values[shown], errors[shown], names)
        axes.set_xlabel(x.words)
        axes.set_ylabel(f"{what} ({unit})")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    data = (series(x.name, x.unit, x.values), *(series(n, unit, errors[:, k]) for k, n in enumerate(names)))
    return Figure(key, svg, alt, f"{what.capitalize()} in camera axes against {of}, held-out captures.", data)


def _against_axis(table: ErrorTable, errors: FloatArray, i: int, axis: Axis) -> Figure:
    is_linear = axis.kind == "linear"
    unit, column = "mm" if is_linear else "deg", table.axis_position[:, i]
    position = mm_from_m(column) if is_linear else deg_from_rad(column)
    key = f"position-axis-{i + 1}"
    alt = (
        f"Components of the position error against axis {axis.name} from {position.min():.4g} to {position.max():.4g} "
        f"{unit}: strongest correlation {_strongest(position, errors)}."
    )
    with style(key):
        figure, axes = plain_axes(2.9)
        shown = thinned(table.count)
        _scatter(axes, position[shown], errors[shown], _POSITION)
        axes.set_xlabel(f"machine position of axis {axis.name} ({unit})".replace("$", r"\$"))
        axes.set_ylabel("position error (mm)")
        legend_above(axes, 3)
        svg = svg_of(figure, key, alt)
    caption = f"Position error in camera axes against machine axis {axis.name}, held-out captures."
    data = (
        series(f"axis {axis.name}", unit, position),
        *(series(n, "mm", errors[:, k]) for k, n in enumerate(_POSITION)),
    )
    return Figure(key, svg, alt, caption, data)


def _strongest(position: FloatArray, errors: FloatArray) -> str:
    if np.ptp(position) == 0.0 or len(position) < 3:
        return "none to be had"
    known = [(k, errors[:, k]) for k in range(3) if np.ptp(errors[:, k]) > 0.0]
    if not known:
        return "none to be had"
    k, r = max(((k, float(np.corrcoef(position, e)[0, 1])) for k, e in known), key=lambda pair: abs(pair[1]))
    return f"{_POSITION[k]}, {r:+.2f}"


def _against_time(run: Run, table: ErrorTable, in_sample: ErrorTable | None) -> Figure:
    start = run.samples[0].t_ns if run.samples else int(table.t_ns[0])
    held_s = _seconds(table, start)
    held_mm = mm_from_m(table.position_error_m)
    half = len(held_mm) // 2
    early = float(np.median(held_mm[: max(half, 1)]))
    key = "time"
    alt = (
        f"Length of the position error over {held_s.max():.0f} s of the run. Held-out captures: median {early:.3g} mm "
        f"in the first half, {np.median(held_mm[half:]):.3g} mm in the second."
    )
    parts_mm = mm_from_m(table.translation_error_m)
    data = [
        series("time", "s", held_s),
        series("position error", "mm", held_mm),
        *(series(name, "mm", parts_mm[:, k]) for k, name in enumerate(_POSITION)),
        series("attitude error", "deg", deg_from_rad(table.attitude_error_rad)),
    ]
    with style(key):
        figure, axes = plain_axes(2.9)
        if in_sample is not None and in_sample.is_solved.any():
            fitted = in_sample.select(in_sample.is_solved)
            shown = thinned(fitted.count)
            fitted_s, fitted_mm = _seconds(fitted, start), mm_from_m(fitted.position_error_m)
            draw_marks(
                axes, np.stack([fitted_s, fitted_mm])[:, shown], "x", colour=FAINT, size_pt=4.0, label="in sample"
            )
            data += [
                series("time in sample", "s", fitted_s),
                series("position error in sample", "mm", fitted_mm),
                series("attitude error in sample", "deg", deg_from_rad(fitted.attitude_error_rad)),
            ]
        shown = thinned(table.count)
        draw_marks(axes, np.stack([held_s, held_mm])[:, shown], "o", colour=SERIES[0], alpha=0.8, label="held out")
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("time since the first capture (s)")
        axes.set_ylabel("position error (mm)")
        legend_above(axes, 2)
        svg = svg_of(figure, key, alt)
    caption = "Length of the position error over the run; a trend points at drift."
    return Figure(key, svg, alt, caption, tuple(data), live="zoom")


def _seconds(table: ErrorTable, start_ns: int) -> FloatArray:
    # Differences of integers first: nanoseconds since 1970 do not fit a float.
    return np.array([s_from_ns(int(t) - start_ns) for t in table.t_ns], dtype=np.float64)
