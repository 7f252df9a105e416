"""Maps over the camera's picture: levels everybody reads alike, circles of what was covered and what may be used."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.camera.projection_uncertainty import picture_grid
from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.figures import WIDTH_IN, canvas
from uvgs_bench.report.palette import FAINT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_COLUMNS, _ROWS = 41, 31
_WISHED_LEVELS, _MOST_LEVELS = 6, 9
_BAR_IN = 1.0


def map_grid(lens: Lens) -> FloatArray:
    """Pixels a map is evaluated at, in rows and columns, shape (H, W, 2), px."""
    return picture_grid(lens, _COLUMNS, _ROWS).reshape(_ROWS, _COLUMNS, 2)


def picture_canvas(width_px: float, height_px: float) -> tuple[Canvas, Axes]:
    """An empty figure whose axes are the picture, pixel centres on whole numbers, rows downwards.

    Args:
        width_px: Width of the picture, px.
        height_px: Its height, px.

    Returns:
        Figure and axes.
    """
    height_in = (WIDTH_IN - _BAR_IN) * height_px / width_px + 0.75
    figure = canvas(float(np.clip(height_in, 2.2, 5.5)))
    axes = figure.add_subplot()
    axes.set_xlim(-0.5, width_px - 0.5)
    axes.set_ylim(height_px - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("column (px)")
    axes.set_ylabel("row (px)")
    axes.grid(False)
    return figure, axes


def draw_map(figure: Canvas, axes: Axes, grid_px: FloatArray, values: FloatArray, label: str) -> None:
    """Fill the picture with bands of values between round levels, light where they are large.

    Args:
        figure: The figure.
        axes: Its axes, from ``picture_canvas``.
        grid_px: Pixels in rows and columns, shape (H, W, 2), px.
        values: There, shape (H, W), not negative; NaN leaves a hole.
        label: Of the colour bar, with its unit.
    """
    from matplotlib.colors import BoundaryNorm

    levels = band_levels(values)
    options: dict[str, Any] = {"levels": levels, "cmap": "cividis", "extend": "both"}
    options["norm"] = BoundaryNorm(levels, 256, extend="both")
    shown = axes.contourf(grid_px[0, :, 0], grid_px[:, 0, 1], np.ma.masked_invalid(values), **options)
    bar = figure.colorbar(shown, ax=axes, label=label, shrink=0.92, ticks=levels, spacing="uniform")
    bar.ax.set_yticklabels([f"{level:g}" for level in levels])


def band_levels(values: FloatArray) -> list[float]:
    """Round levels that divide most of the values; the largest few are left to the last band."""
    finite = values[np.isfinite(values) & (values > 0.0)]
    if not finite.size:
        return [0.5, 1.0]
    low, high = float(finite.min()), float(np.percentile(finite, 98.0))
    for steps in ((1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        inside = [float(f"{m * 10.0**p:g}") for p in range(-9, 10) for m in steps if low < m * 10.0**p < high]
        if len(inside) >= _WISHED_LEVELS:
            break
    if len(inside) < 3:
        # Hardly any range: equal steps tell more than one line would.
        ends = np.linspace(low, max(high, low * (1.0 + 1e-6)), 6)
        return [float(f"{level:.3g}") for level in ends] if len({f"{e:.3g}" for e in ends}) == 6 else [low, 2.0 * low]
    return inside[-_MOST_LEVELS:]


def draw_circles(axes: Axes, lens: Lens, covered_px: float, usable_px: float) -> None:
    """Circles about the principal point, readable on every colour.

    Args:
        axes: Axes of a picture.
        lens: For the principal point.
        covered_px: Radius that boards covered, px; 0 leaves it out.
        usable_px: Radius within which the calibration may be used, px; 0 leaves it out.
    """
    circles = [(covered_px, "--", "covered by boards"), (usable_px, "-", "usable")]
    if abs(covered_px - usable_px) < 1.0:
        circles = [(usable_px, "-", "usable, covered by boards")]
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    for radius_px, line, label in circles:
        if radius_px > 0.0:
            u, v = lens.cx_px + radius_px * np.cos(turn), lens.cy_px + radius_px * np.sin(turn)
            axes.plot(u, v, "-", color="#000000", lw=2.6, alpha=0.55)
            axes.plot(u, v, line, color="#ffffff", lw=1.4, label=label)
    if not any(radius_px > 0.0 for radius_px, _, _ in circles):
        return
    legend = axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2, handlelength=1.6, columnspacing=1.0
    )
    for handle in legend.legend_handles:
        # White lines would vanish on the page beside the map.
        if handle is not None:
            handle.set(color=FAINT)
