"""A beacon as a table and as drawings in its own frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Figure, Table
from uvgs_bench.report.figures import label_of, plain_axes, series, style, svg_of
from uvgs_bench.report.palette import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE
from uvgs_bench.units import deg_from_rad, mm_from_m

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXIS_COLOURS = (ORANGE, GREEN, PURPLE)


def views_of(beacon: Beacon) -> tuple[tuple[str, tuple[int, int], str], ...]:
    """Key, horizontal and vertical axis of the beacon frame, and words of each drawing.

    A frame may be set so that the LEDs shine along its +z; then the drawing along z shows the beacon's back.
    """
    ahead = sum(float(led.axis[2]) for led in beacon.leds if led.axis is not None)
    side_of_z = "from the front, as the camera sees it" if ahead < 0.0 else "from behind: its LEDs shine along +z"
    return ("front", (0, 1), side_of_z if ahead else "along its z axis"), ("side", (2, 1), "from the side")


def led_table(beacon: Beacon) -> Table:
    """LED positions with their doubt."""
    sigma_mm = None
    if beacon.covariance_m2 is not None:
        sigma_mm = mm_from_m(np.sqrt(np.diag(beacon.covariance_m2)).reshape(-1, 3))
    rows: list[tuple[Cell, ...]] = []
    for k, led in enumerate(beacon.leds):
        doubt = None if sigma_mm is None else float(np.sqrt((sigma_mm[k] ** 2).sum()))
        rows.append(
            (
                led.name,
                *(Number(mm_from_m(float(p)), 3) for p in led.position_m),
                Number(doubt, 3),
                Number(None if led.half_angle_rad is None else deg_from_rad(led.half_angle_rad), 1),
                Number(None if led.diameter_m is None else mm_from_m(led.diameter_m), 2),
            )
        )
    columns = (
        Column("LED"),
        *(Column(axis, "mm", True) for axis in "xyz"),
        Column("Doubt, 3-D", "mm", True),
        Column("Half angle", "deg", True),
        Column("Diameter", "mm", True),
    )
    hue = beacon.hue if isinstance(beacon.hue, str) else f"{beacon.hue[0]:g}° to {beacon.hue[1]:g}°"
    known = "measured" if sigma_mm is not None else "not measured: LED errors act like a pose bias and a scale"
    caption = f"Beacon {beacon.name}, {len(beacon.leds)} LEDs, hue {hue}, beacon frame; covariance {known}."
    return Table(caption, columns, tuple(rows))


def beacon_figures(beacon: Beacon, nominal_m: FloatArray | None = None) -> tuple[Figure, ...]:
    """The beacon from the front and from the side, with its frame.

    Args:
        beacon: The beacon.
        nominal_m: Where its LEDs were meant to be, beacon frame, shape (N, 3), m; drawn as crosses.

    Returns:
        One figure per entry of ``views_of``.
    """
    p = mm_from_m(beacon.positions_m)
    size_mm = float(max(np.linalg.norm(a - b) for a in p for b in p))
    depth_mm = float(np.ptp(p[:, 2]))
    figures = []
    for key, pair, words in views_of(beacon):
        name = f"beacon-{key}"
        alt = (
            f"Beacon {beacon.name} {words}: {len(p)} LEDs, the farthest two {size_mm:.1f} mm apart, {depth_mm:.1f} mm "
            "deep along z; the axes of its frame are drawn at its origin."
        )
        with style(name):
            figure, axes = plain_axes(3.6)
            draw_view(axes, beacon, pair, nominal_m)
            svg = svg_of(figure, name, alt)
        crosses = "" if nominal_m is None else " Crosses: nominal, laid onto the measured LEDs."
        caption = f"The beacon {words}, in its own frame.{crosses}"
        numbers = tuple(series(axis, "mm", p[:, k]) for k, axis in enumerate("xyz")) if key == "front" else ()
        figures.append(Figure(name, svg, alt, caption, numbers))
    return tuple(figures)


def draw_view(axes: Axes, beacon: Beacon, pair: tuple[int, int], nominal_m: FloatArray | None = None) -> None:
    """Draw LEDs, the lines between them and the frame in a plane of the beacon frame.

    Args:
        axes: Where to draw.
        beacon: The beacon.
        pair: Numbers of the horizontal and the vertical axis.
        nominal_m: As in ``beacon_figures``.
    """
    a, b = pair
    p = mm_from_m(beacon.positions_m)
    size = float(np.ptp(p, axis=0).max())
    for i in range(len(p)):
        for j in range(i + 1, len(p)):
            axes.plot(p[[i, j], a], p[[i, j], b], color=FAINT, lw=0.7, alpha=0.6)
    axes.plot(p[:, a], p[:, b], "o", color=BLUE, ms=7)
    if nominal_m is not None:
        q = mm_from_m(nominal_m)
        axes.plot(q[:, a], q[:, b], "+", color=INK, ms=9, mew=1.3)
    for led, place in zip(beacon.leds, p, strict=True):
        axes.annotate(
            label_of(led.name), (place[a], place[b]), (7, 6), textcoords="offset points", color=INK, fontsize=8.5
        )
    for k in pair:
        tip = 0.25 * size * np.eye(3)[k]
        arrow = {"arrowstyle": "->", "color": _AXIS_COLOURS[k], "lw": 1.6}
        axes.annotate("", (tip[a], tip[b]), (0.0, 0.0), arrowprops=arrow)
        axes.annotate("xyz"[k], (1.15 * tip[a], 1.15 * tip[b]), color=_AXIS_COLOURS[k], ha="center", va="center")
    axes.margins(0.22)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.set_xlabel(f"{'xyz'[a]} (mm)")
    axes.set_ylabel(f"{'xyz'[b]} (mm)")
