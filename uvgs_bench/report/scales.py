"""The scales of a chart as two lines and a few texts: matplotlib's own ticks take most of the time of a drawing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.palette import FAINT, INK, RULE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TICK_PT, _PAD_PT, _TEXT_PT, _NAME_PT = 3.5, 3.0, 8.5, 9.5
_POINTS_PER_IN = 72.0
# Widths of letters and digits, and of any other sign, in parts of the size of their text.
_LETTER, _SIGN = 0.64, 0.38


def draw_scales(axes: Axes) -> None:
    """Draw grid, ticks, numbers and names of both axes as they now are, and hide matplotlib's own.

    Args:
        axes: Finished axes with a fixed place in their figure and linear scales; nothing may be drawn after this.
    """
    axes.apply_aspect()
    figure: Any = axes.figure
    width_pt, height_pt = _POINTS_PER_IN * np.asarray(axes.get_position().size) * figure.get_size_inches()
    below, beside = 1.0 / height_pt, 1.0 / width_pt
    far = _TICK_PT + _PAD_PT
    text: dict[str, Any] = {"color": INK, "fontsize": _TEXT_PT}
    name: dict[str, Any] = {"color": INK, "fontsize": _NAME_PT, "transform": axes.transAxes}
    values, labels, has_grid = _ticks(axes.xaxis, axes.get_xlim())
    across = axes.get_xaxis_transform()
    for value, label in zip(values, labels, strict=True):
        axes.text(value, -far * below, label, ha="center", va="top", transform=across, **text)
    _draw_lines(axes, values, -_TICK_PT * below, has_grid, is_x=True)
    axes.text(0.5, -(far + 1.2 * _TEXT_PT + _PAD_PT) * below, axes.get_xlabel(), ha="center", va="top", **name)
    values, labels, has_grid = _ticks(axes.yaxis, axes.get_ylim())
    along = axes.get_yaxis_transform()
    for value, label in zip(values, labels, strict=True):
        axes.text(-far * beside, value, label, ha="right", va="center_baseline", transform=along, **text)
    _draw_lines(axes, values, -_TICK_PT * beside, has_grid, is_x=False)
    widest_pt = _POINTS_PER_IN * widest_in(labels)
    side: dict[str, Any] = {"ha": "center", "va": "bottom", "rotation": 90.0, "rotation_mode": "anchor"}
    axes.text(-(far + widest_pt + _PAD_PT + 1.0) * beside, 0.5, axes.get_ylabel(), **side, **name)
    axes.xaxis.set_visible(False)
    axes.yaxis.set_visible(False)


def widest_in(labels: Iterable[str]) -> float:
    """About how wide the widest word at a tick is, inches."""
    parts = (sum(_LETTER if c.isalnum() else _SIGN for c in label) for label in labels)
    return _TEXT_PT * max(parts, default=0.0) / _POINTS_PER_IN


def _ticks(axis: Any, ends: tuple[float, float]) -> tuple[FloatArray, list[str], bool]:
    """Places of the ticks, their words, and whether lines of the grid belong to them."""
    values = np.asarray(axis.get_majorticklocs(), dtype=np.float64)
    labels = axis.get_major_formatter().format_ticks(values)
    low, high = sorted(ends)
    slack = 1e-9 * (high - low)
    kept = (values >= low - slack) & (values <= high + slack)
    chosen = [label for label, is_kept in zip(labels, kept, strict=True) if is_kept]
    return values[kept], chosen, bool(axis.get_tick_params().get("gridOn", False))


def _draw_lines(axes: Axes, values: FloatArray, outside: float, has_grid: bool, *, is_x: bool) -> None:
    """Ticks as one line with gaps, the grid as another; ``outside`` is the end of a tick in parts of the axes."""
    from matplotlib.lines import Line2D

    across = axes.get_xaxis_transform() if is_x else axes.get_yaxis_transform()
    at = np.stack([values, values, np.full(len(values), np.nan)], axis=1).ravel()
    for end, colour, width, order in ((outside, FAINT, 0.8, 2.0), (1.0, RULE, 0.6, 0.5)):
        if end == 1.0 and not has_grid:
            continue
        reach = np.tile([0.0, end, np.nan], len(values))
        line = Line2D(*((at, reach) if is_x else (reach, at)), color=colour, lw=width, zorder=order)
        line.set(transform=across, clip_on=False)
        axes.add_artist(line)
