"""The drawing toolkit of all sections: a figure with the house style, and its SVG, the same bytes each time.

Drawn with matplotlib's objects, never its global state, so that nothing leaks between reports.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.report.document import Series
from uvgs_bench.report.palette import FAINT, INK, RULE
from uvgs_bench.report.scales import draw_scales, widest_in

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

WIDTH_IN = 4.9
"""Narrow enough to be read on a telephone without zooming, two side by side on paper."""

MOST_POINTS = 800
"""A drawing of more points than this is thinned; the exported numbers are never."""

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.labelsize": 9.5,
    "axes.titlesize": 9.5,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": False,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "path",
}


def style(key: str) -> Any:
    """The house style as a context; everything is drawn and saved inside it.

    Args:
        key: The figure's key; it salts the identifiers within the drawing.

    Returns:
        A context manager.
    """
    import matplotlib

    return matplotlib.rc_context({**_STYLE, "svg.hashsalt": key})


def canvas(height_in: float = 3.3, *, arranges_itself: bool = True) -> Canvas:
    """An empty figure.

    Args:
        height_in: Height, inches.
        arranges_itself: Whether it chooses its own margins.

    Returns:
        The matplotlib figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained" if arranges_itself else None)
    FigureCanvasAgg(figure)
    return figure


def plain_axes(height_in: float = 3.3, names: Sequence[str] = ()) -> tuple[Canvas, Axes]:
    """A figure with one pair of axes in margins fit for usual numbers: the same in every drawing, and quick to draw.

    Args:
        height_in: Height, inches.
        names: Words at the ticks of the upright axis, which then has no name of its own.

    Returns:
        Figure and axes.
    """
    figure = canvas(height_in, arranges_itself=False)
    right, bottom, top = 0.1, 0.5, 0.3
    left = 0.2 + widest_in(names) if names else 0.74
    sides = (left / WIDTH_IN, bottom / height_in, 1.0 - (left + right) / WIDTH_IN, 1.0 - (bottom + top) / height_in)
    return figure, figure.add_axes(sides)


def svg_of(figure: Canvas, key: str, alt: str) -> str:
    """The drawing as one ``<svg>`` element that scales with its column and names itself to screen readers.

    Args:
        figure: What was drawn.
        key: The figure's key; it prefixes every identifier, because drawings share one page.
        alt: Alternative text.

    Returns:
        The element. The same drawing gives the same bytes.
    """
    from html import escape

    if figure.get_layout_engine() is None:
        for axes in figure.axes:
            if axes.axison:
                draw_scales(axes)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r"\bid=\"([^\"]+)\"", rf'id="{key}-\1"', svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{key}-\1)", svg)
    svg = re.sub(r"xlink:href=\"#([^\"]+)\"", rf'xlink:href="#{key}-\1"', svg)
    label = escape(alt, quote=True)
    head, rest = svg.split(">", 1)
    return f'{head} role="img" aria-label="{label}">{rest}'


def label_of(name: str, most: int = 16) -> str:
    """A name people gave, safe and short enough for a drawing; the page beside it has it whole."""
    short = name if len(name) <= most else f"{name[: most - 1]}…"
    # A dollar sign would open a formula.
    return short.replace("$", r"\$")


def legend_above(axes: Axes, columns: int) -> None:
    """Put the legend above the axes, where it covers no point."""
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (-0.02, 1.0), "borderaxespad": 0.0}
    axes.legend(ncols=columns, handletextpad=0.3, columnspacing=1.2, **place)


def thinned(count: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Evenly spread indices of at most ``MOST_POINTS`` of so many points."""
    if count <= MOST_POINTS:
        return np.arange(count, dtype=np.int64)
    return np.linspace(0, count - 1, MOST_POINTS).round().astype(np.int64)


def series(name: str, unit: str, values: FloatArray | Sequence[float]) -> Series:
    """Numbers behind a figure."""
    return Series(name, unit, tuple(float(v) for v in values))


def symmetric_limits(axes: Axes, values: FloatArray, which: str = "y") -> None:
    """Centre an axis on zero, so that a bias is seen as one."""
    finite = np.abs(values[np.isfinite(values)])
    reach = 1.08 * float(finite.max()) if finite.size and float(finite.max()) > 0.0 else 1.0
    if which == "y":
        axes.set_ylim(-reach, reach)
    else:
        axes.set_xlim(-reach, reach)
