"""Drawing in space: a parallel projection of the camera's axes in a box whose edges carry the scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.figures import WIDTH_IN, canvas
from uvgs_bench.report.palette import RULE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_LIFT_RAD = 0.38
_LEAST_HEIGHT_IN, _MOST_HEIGHT_IN = 2.3, 4.3
_SIDE_IN, _TEXT_IN = 0.12, 0.4
_LEGEND_IN = 0.3
_AXES = (("x, right (m)", 0), ("y, down (m)", 1), ("z, forward (m)", 2))
_X, _Y, _Z = range(3)


@dataclass(frozen=True, slots=True, eq=False)
class SpaceView:
    """Axes that show space from one side.

    Args:
        axes: Plane axes, in m of the projection.
        matrix: Camera axes to right and up of the drawing, shape (2, 3).
    """

    axes: Axes
    matrix: FloatArray

    def of(self, points: FloatArray) -> FloatArray:
        """Where points are drawn.

        Args:
            points: Camera axes (x right, y down, z forward), shape (..., 3), m; NaN breaks a line.

        Returns:
            Coordinates in ``axes``: right and up, shape (2, ...).
        """
        drawn: FloatArray = np.moveaxis(points @ self.matrix.T, -1, 0)
        return drawn


def space_view(points: FloatArray, *, turn_rad: float = -0.55, below_in: float = 0.0) -> tuple[Canvas, SpaceView]:
    """A figure as high as what it shows, true to scale, with a box around the points and ticks along three edges.

    Args:
        points: Everything that will be drawn, camera axes, shape (N, 3), m.
        turn_rad: How far the eye is turned about the vertical: 0 looks along the camera's axis, -pi/2 from its left.
        below_in: Room kept free below the drawing, inches.

    Returns:
        Figure and view; the top is free for one row of legend.
    """
    s, t, p, q = np.sin(turn_rad), np.cos(turn_rad), np.sin(_LIFT_RAD), np.cos(_LIFT_RAD)
    matrix = np.array([[t, 0.0, -s], [s * p, -q, t * p]])
    low, high = points.min(axis=0), points.max(axis=0)
    # A flat cloud still gets a box that can be seen.
    missing = np.maximum(0.08 * max(float((high - low).max()), 1e-6) - (high - low), 0.0)
    box = np.stack([low - 0.5 * missing, high + 0.5 * missing])
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    flat = corners @ matrix.T
    middle, extent = 0.5 * (flat.min(axis=0) + flat.max(axis=0)), np.ptp(flat, axis=0)
    room_in = WIDTH_IN - 2.0 * (_SIDE_IN + _TEXT_IN)
    lost_in = 2.0 * _TEXT_IN + _LEGEND_IN + below_in
    height_in = float(np.clip(room_in * extent[1] / extent[0] + lost_in, _LEAST_HEIGHT_IN, _MOST_HEIGHT_IN))
    inner_in = height_in - below_in - _LEGEND_IN
    m_per_in = max(extent[0] / room_in, extent[1] / (inner_in - 2.0 * _TEXT_IN))
    figure = canvas(height_in, arranges_itself=False)
    axes = figure.add_axes((0.0, below_in / height_in, 1.0, inner_in / height_in))
    axes.set_axis_off()
    for k, size_in in enumerate((WIDTH_IN, inner_in)):
        reach = 0.5 * m_per_in * size_in
        (axes.set_xlim if k == 0 else axes.set_ylim)(middle[k] - reach, middle[k] + reach)
    view = SpaceView(axes, matrix)
    _draw_box(view, box, corners)
    return figure, view


def _draw_box(view: SpaceView, box: FloatArray, corners: FloatArray) -> None:
    edges = [
        np.array([a, b, np.full(3, np.nan)])
        for n, a in enumerate(corners)
        for b in corners[n + 1 :]
        if (a != b).sum() == 1
    ]
    view.axes.plot(*view.of(np.concatenate(edges)), "-", color=RULE, lw=0.8, zorder=0)
    middle = view.of(box.mean(axis=0))
    right = view.matrix[0]
    for label, axis in _AXES:
        # Along the outline: the lowest edges of the floor, and the leftmost upright.
        start = np.where(right > 0.0, box[0], box[1]) if axis == _Y else box[1].copy()
        if axis == _X:
            start[_Z] = box[0, _Z] if view.matrix[1, _Z] > 0.0 else box[1, _Z]
        if axis == _Z:
            start[_X] = box[0, _X] if view.matrix[1, _X] > 0.0 else box[1, _X]
        _draw_scale(view, box[:, axis], start, axis, label, middle)


def _draw_scale(
    view: SpaceView, ends: FloatArray, start: FloatArray, axis: int, label: str, middle: FloatArray
) -> None:
    """Ticks and the name of one edge, on the side away from the middle of the drawing."""
    from matplotlib.ticker import MaxNLocator

    along = view.matrix[:, axis] / np.linalg.norm(view.matrix[:, axis])
    away = np.array([-along[1], along[0]])
    line = np.repeat(start[None], 2, axis=0)
    line[:, axis] = ends
    drawn = view.of(line).T
    if away @ (drawn.mean(axis=0) - middle) < 0.0:
        away = -away
    values = [v for v in MaxNLocator(nbins=4, steps=[1, 2, 5, 10]).tick_values(*ends) if ends[0] <= v <= ends[1]]
    ha = "center" if abs(away[0]) < 0.35 else "left" if away[0] > 0.0 else "right"
    style: dict[str, Any] = {"textcoords": "offset points", "ha": ha, "va": "center", "fontsize": 7.5}
    turn_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
    for value in values:
        at = start.copy()
        at[axis] = value
        place = _pair(view.of(at))
        tick = {"arrowstyle": "-", "color": RULE, "lw": 0.8, "shrinkA": 0.0, "shrinkB": 0.0}
        view.axes.annotate("", place, _pair(4.0 * away), textcoords="offset points", arrowprops=tick)
        view.axes.annotate(f"{value:g}", place, _pair(8.0 * away), **style)
    upright_deg = 90.0 - (90.0 - turn_deg) % 180.0
    words = {**style, "ha": "center", "fontsize": 8.5, "rotation": upright_deg, "rotation_mode": "anchor"}
    view.axes.annotate(label, _pair(drawn.mean(axis=0)), _pair((21.0 if ha == "center" else 33.0) * away), **words)


def _pair(point: FloatArray) -> tuple[float, float]:
    return float(point[0]), float(point[1])
